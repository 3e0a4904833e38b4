"""Sizes of waves of any order at each joint that would have been found: `none` excludes larger ones only."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, eigen_of_pairs
from identification.gap.hypotheses.detectability import LARGEST, Size, detectable_lambda
from identification.gap.hypotheses.f_tests import Columns
from identification.gap.outside.further_orders import EFFECT, LOWEST
from identification.gap.outside.unmodelled_shapes import WAVES
from identification.gap.outside.unmodelled_survey import FRACTION, LEVEL_FIRST, shape_columns
from identification.gap.selection.search import HypothesisSearch

ANY = "[any k]"  # stands for the order in names


def excluded_waves(search: HypothesisSearch, sigma: float) -> dict[str, Size]:
    """`transmission_ripple:j[any k]` -> by how much a wave at joint j moves the tip [mm, RMS] if it is found.

    It is the size that the test of all shapes, beside nothing named, finds with 90 % power at the order hardest to see;
    none where such an order cannot be seen at all, as one with the spacing of a grid.

    sigma : noise of one coordinate [mm]
    """
    first = search.fit(())
    surveyed = list(shape_columns(first))
    level = LEVEL_FIRST * search.level_factor / len(surveyed)
    limit = LARGEST * search.hypotheses.base.reach
    found = {}
    for place, columns in surveyed:
        waves = np.array([WAVES.get(shape, 0.0) >= LOWEST for shape in place.shapes])
        if waves.any():
            needed = detectable_lambda(2, first.freedom - 2, level / len(place.shapes))
            seen = sigma * needed * _largest(first.basis, columns, waves) / np.sqrt(len(search.rows))
            joint = place.place.partition(":")[2]
            found[f"{EFFECT}:{joint}{ANY}"] = Size(float(seen), "mm", float(seen)) if seen < limit else Size(None, "mm")
    return found


def _largest(basis: Array, columns: Columns, waves: NDArray[np.bool_]) -> float:
    """Largest ratio, over waves, of the length of a wave to the least that is left of it off a model.

    basis : (N, r) orthonormal, of the model;  waves : (S,) True for the shapes that count, each of two columns

    The length is the root mean square over phases. Infinite where less than `FRACTION` is left.
    """
    members, places = columns.places(2)
    inside = (basis.T @ columns.matrix).T[places]
    whole = columns.products[2]
    left = eigen_of_pairs(whole - inside @ inside.transpose(0, 2, 1))[0][:, 0]
    shares = left / (0.5 * np.einsum("kcc->k", whole))
    least = float(shares[waves[members]].min())
    return np.inf if least <= FRACTION**2 else 1.0 / np.sqrt(least)


def waves_clause(excluded: Mapping[str, Size]) -> list[str]:
    """The largest of these sizes in words; empty if there are none."""
    sizes = [size for name, size in excluded.items() if name.endswith(ANY)]
    if not sizes:
        return []
    most = max(sizes, key=Size.order)
    said = "any size" if most.value is None else f"up to {most} at the tip"
    return [f"a wave of unknown order at a joint, of {said}, is not excluded"]
