"""Where base and measured point cannot be told apart: the flange turned too little.

    y_i = B (p_i + R_i t) + b

A shift of the point t along v and the shift of the base that follows it move measured points by B (R_i - mean R) v and
no more. Its mean square is v^T (I - (mean R)^T mean R) v: zero along every v where the flange keeps one orientation,
and along the axis where it turns about one only, however many rows there are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from identification.arrays import Array
from identification.kinematics.spatial import BASE, TOOL, SpatialChain
from identification.measurements import Measurements
from identification.model.placed import tip_frames

if TYPE_CHECKING:
    from identification.estimation.result import Identification

TOGETHER = "base and tool cannot be told apart"  # the beginning of that sentence
HARDLY = np.sin(np.radians(5.0))  # turned by less: as little as joints that hardly move
CAUSE = 2.0  # times less uncertain with the tool given: it is the reason
POSES = 1000  # random postures that show how an arm can turn its flange


def flange_turns(chain: SpatialChain, measurements: Measurements) -> Array:
    """(3,) root mean square motion of a point 1 mm from the flange's center that its base follows [mm], by the axes
    along which it is, the least first. Each session has a base of its own."""
    turns, square = tip_frames(chain, measurements.postures)[:, :3, :3], np.zeros((3, 3))
    for rows in measurements.session_rows:
        apart = turns[rows] - turns[rows].mean(axis=0)
        square += np.einsum("mji,mjk->ik", apart, apart)
    return np.asarray(np.sqrt(np.linalg.eigvalsh(square / len(turns)).clip(min=0.0)))


def turns_measured(model: object, measurements: Measurements) -> Array | None:
    """`flange_turns` of a fit of both base and tool; None for others."""
    arm = getattr(model, "arm", None)
    if arm is None or arm.chain.planar or {BASE, TOOL} & arm.chain.known:
        return None
    return flange_turns(arm.chain, measurements)


def base_and_tool(fit: Identification, tip: Callable[[Array], float] | None) -> list[str]:
    """The sentence that names it, where it is what leaves a fit uncertain; else none.

    tip : expected error of the tip [mm] with a covariance (p, p); None: something is not identifiable at all
    """
    if (turns := fit.flange_turns) is None or turns[0] > HARDLY:
        return []
    arm = fit.model.arm
    tools = [k for k, p in enumerate(fit.model.parameters) if p.kind == TOOL]
    if not tools:
        return []
    if tip is None and all(fit.identifiable[tools]):
        return []
    if tip is not None:
        across = fit.covariance[:, tools]
        within = np.linalg.pinv(fit.covariance[np.ix_(tools, tools)], hermitian=True)
        if CAUSE * tip(fit.covariance - across @ within @ across.T) > tip(fit.covariance):  # with the tools known
            return []
    anywhere = np.random.default_rng(0).uniform(arm.lower, arm.upper, (POSES, arm.links))
    able = flange_turns(arm.chain, Measurements(anywhere, np.zeros((POSES, 3))))
    if able[0] <= HARDLY:  # all its axes are parallel
        return []
    how = "by 45 deg and more, or give [tool]"
    if turns[1] <= HARDLY:  # mean squares of small turns a about x, y, z: y^2 + z^2, x^2 + z^2, x^2 + y^2
        angle = np.degrees(np.sqrt(np.sum(turns**2) / 2.0))
        kept = f"the flange kept one orientation, turned by {round(float(angle), 4):.2g} deg (RMS)"
        return [f"{TOGETHER}: {kept}. Measure postures that turn it about two axes {how}"]
    kept = f"the flange turned about one axis only, about others by {np.degrees(turns[0]):.2g} deg (RMS)"
    return [f"{TOGETHER}: {kept}. Measure postures that turn it about another axis, too, {how}"]
