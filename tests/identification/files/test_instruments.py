"""Arm files with an `[instrument]`: what comes back, where it stands, and what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from identification.arm import Arm
from identification.errors import InputError
from identification.files.arm import dump_arm, load_arm
from identification.instruments import Distance, Instrument, PlanarDistance, Plane, Sphere

HEAD = 'kind = "spatial"\n[[dh]]\na_mm = 300.0\nalpha_deg = 0.0\nd_mm = 10.0\n'
PLANAR = "links_mm = [300.0, 200.0]\n"


def load(folder: Path, lines: str, head: str = HEAD) -> Arm:
    (folder / "arm.toml").write_text(f"{head}[instrument]\n{lines}\n")
    return load_arm(folder / "arm.toml")


@pytest.mark.parametrize(
    ("head", "lines", "instrument", "base"),
    [
        (HEAD, 'kind = "distance"\ncenter_mm = [700.0, -200.0, 300.0]', Distance(), [-700.0, 200.0, -300.0]),
        (HEAD, 'kind = "sphere"\nradius_mm = 12.5', Sphere(12.5), [0.0, 0.0, 0.0]),
        (HEAD, 'kind = "sphere"', Sphere(), [0.0, 0.0, 0.0]),
        (HEAD, 'kind = "plane"', Plane(), [0.0, 0.0, 0.0]),
        (PLANAR, 'kind = "distance"\ncenter_mm = [400.0, 100.0]', PlanarDistance((("1", (400.0, 100.0)),)), [0, 0, 0]),
    ],
)
def test_what_is_measured_comes_back(
    tmp_path: Path, head: str, lines: str, instrument: Instrument, base: list[float]
) -> None:
    arm = load(tmp_path, lines, head)
    (tmp_path / "again.toml").write_text(dump_arm(arm))
    for one in (arm, load_arm(tmp_path / "again.toml")):
        assert one.chain.instrument == instrument
        np.testing.assert_allclose(one.chain.base[:3, 3], base)
        assert one.chain.settled == arm.chain.settled
    assert head == PLANAR or not arm.chain.settled


def test_where_a_plane_is(tmp_path: Path) -> None:
    """Its point is at height zero, and so is what lies beside it across the normal."""
    arm = load(tmp_path, 'kind = "plane"\ncenter_mm = [100.0, 20.0, -50.0]\nnormal = [0.0, 3.0, 4.0]')
    base = arm.chain.base
    for point, height in (([100, 20, -50], 0.0), ([300, 24, -53], 0.0), ([100, 23, -46], 5.0)):
        assert base[2, :3] @ point + base[2, 3] == pytest.approx(height, abs=1e-9)
    np.testing.assert_allclose(base[:3, :3] @ base[:3, :3].T, np.eye(3), atol=1e-12)


CENTER = "center_mm = [1.0, 2.0, 3.0]"


@pytest.mark.parametrize(
    ("head", "lines", "said"),
    [
        (HEAD, 'kind = "tracker"', "instrument.kind: found 'tracker' for a spatial arm, allowed: distance, plane, "),
        (HEAD, 'kind = "distance"\nradius_mm = 3.0', "radius_mm: found for kind distance, allowed: for sphere"),
        (HEAD, f'kind = "plane"\n{CENTER}', "instrument.normal: is missing beside center_mm"),
        (HEAD, 'kind = "plane"\nnormal = [1.0, 2.0, 3.0]', "instrument.center_mm: is missing beside normal"),
        (HEAD, f'kind = "plane"\n{CENTER}\nnormal = [0, 0, 0]', "normal: found .0, 0, 0., allowed: a direction"),
        (HEAD, 'kind = "distance"\ncenter_mm = [1.0, 2.0]', "center_mm: found .1.0, 2.0., allowed: three numbers"),
        (HEAD, f'kind = "distance"\n{CENTER}\n[base]\nx_mm = 1.0', "instrument.center_mm: found beside"),
        (HEAD, 'kind = "distance"\n[measurement]\nsigma_mm = 1.0\nsigma_deg = 1.0', "sigma_deg: found beside"),
        (
            HEAD,
            f'kind = "socket"\n{CENTER}',
            "instrument.center_mm: found for kind socket, allowed: for distance, plane",
        ),
        (HEAD, 'kind = "socket"\ncups = {A = [1.0, 2.0]}', "allowed: three numbers"),
        (HEAD, 'kind = "socket"\ndistances_mm = [["A", 3.0]]', "distances_mm.1..2.: found 3.0, allowed: a string"),
        (HEAD, 'kind = "socket"\n[base]\nx_mm = 3.0', "base: found with an .instrument. of kind socket, allowed: left"),
        (PLANAR, 'kind = "sphere"', "instrument.kind: found 'sphere' for a planar arm, allowed: distance"),
        (PLANAR, f'kind = "distance"\n{CENTER}', "center_mm: found .1.0, 2.0, 3.0., allowed: two numbers"),
        (PLANAR, 'kind = "distance"\n[[effects]]\nname = "base_offset"', "base_offset is of measured positions, found"),
    ],
)
def test_what_cannot_be_is_one_line(tmp_path: Path, head: str, lines: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load(tmp_path, lines, head)
