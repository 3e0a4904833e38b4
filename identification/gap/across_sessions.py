"""Whether an effect is the same in every session: effects of the robot return, effects of a set-up do not.

The four explanations of its values t in one session and o in the others (identification/README.md, "Several sessions")
are sets of blocks (see `likelihood`): the effect's columns, restricted to the rows of that session or of the others.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.special import logsumexp, softmax

from identification.gap.fit import Fitted
from identification.gap.likelihood import SIZES, Products, orthonormal
from identification.gap.search import CREDIBLE
from identification.information import PRODUCT_TOLERANCE, VISIBLE

SAME = 0.1  # relative difference of values that are the same; convention: temperature and load differ by session


def replications(fitted: Fitted, names: Sequence[str], labels: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Entries of `replication` (identification/files/README.md, "JSON keys"), of named effects; none of one session.

    fitted : with these effects;  names : of the sessions in the order of their numbers;  labels : of the effects
    """
    rows, model, session = fitted.rows, fitted.model, fitted.rows.conditions.session
    if session is None or np.ptp(session) == 0.0:
        return
    jacobian, scaled = fitted.linearized[1] / model.scales, fitted.values * model.scales
    table, n = np.concatenate([jacobian, fitted.errors[:, :, None]], axis=2), jacobian.shape[2] + 1
    grams = []  # of each session (2 n, 2 n): of n whitened columns, the last the residuals, and of their parts in it
    for number in np.unique(session):
        white = rows.whiten(np.concatenate([table, table * (session == number)[:, None, None]], axis=2))
        grams.append(white.T @ white)
    for effect in (e for e in model.effects if e.label in labels):
        columns, parameters = fitted.columns_of(effect), [p for p in effect.parameters if p.name in model.names]
        count, units = len(columns), np.array([p.to_file for p in parameters]) / model.scales[columns]
        asked = np.zeros((2 * n, 1 + 2 * count))  # what is to be explained, the effect, its part in the session
        asked[[*columns, n - 1], 0] = [*scaled[columns], 1.0]  # the fit has the effect
        asked[[*columns, *(columns + n)], np.arange(1, 1 + 2 * count)] = 1.0
        rest, sessions = np.setdiff1d(np.arange(n - 1), columns), list[dict[str, Any]]()
        for name, gram in zip(names, grams, strict=True):
            basis = orthonormal(gram[np.ix_(rest, rest)], PRODUCT_TOLERANCE)
            across = asked.T @ gram[:, rest] @ basis
            left = asked.T @ gram @ asked - across @ across.T
            everywhere, here = np.split(np.eye(1 + 2 * count)[:, 1:], 2, axis=1)
            information = everywhere.T @ left @ everywhere
            entry: dict[str, Any] = {"session": name, "replicates": None, "probability": 0.25, "parameters": []}
            sessions.append(entry)
            if np.trace(information) <= VISIBLE * np.trace(gram[np.ix_(columns, columns)]):
                continue  # nothing that the rest has not
            root = orthonormal(information)  # whose inverse is the prior covariance of an effect
            width = root.shape[1]
            root = root / np.sqrt(max(width, 1))
            everywhere, here = everywhere @ root, here @ root
            blocks = np.hstack([here, everywhere - here, everywhere, SAME * here])
            freedom, starts = max(len(fitted.residual) - basis.shape[1], 1), np.array([0, 1, 2, 4]) * width
            signs = np.zeros(3, dtype=bool)
            products = Products(blocks.T @ left @ blocks, left[0] @ blocks, float(left[0, 0]), freedom, starts, signs)
            in_here, in_others, in_both = products.added(products.state())  # each (sizes,)
            beside = [products.added(products.state([(1, s)]))[0] for s in range(len(SIZES))]
            double = in_others[:, None] + np.array(beside)
            evidence = [logsumexp(odds) - np.log(odds.size) for odds in (in_both, double, in_others, in_here)]
            same, apart, absent, _ = softmax(evidence).tolist()
            answer = True if same >= CREDIBLE else False if apart + absent >= CREDIBLE else None
            # its values there if they are independent of the others
            elsewhere, inside = np.unravel_index(np.argmax(double), double.shape)
            apiece = products.state([(0, int(inside)), (1, int(elsewhere))])
            turn = root * units[:, None]
            deviations = np.sqrt(np.diag(turn @ apiece.covariance[:width, :width] @ turn.T) * apiece.variance)
            values = zip(parameters, (turn @ apiece.mean[:width]).tolist(), deviations.tolist(), strict=True)
            listed = [{"name": p.name, "unit": p.file_unit, "value": v, "std": std} for p, v, std in values]
            entry |= {"replicates": answer, "probability": same, "parameters": listed}
        answers = {one["replicates"] for one in sessions}
        whole = False if False in answers else True if answers == {True} else None
        yield {"effect": effect.label, "replicates": whole, "sessions": sessions}
