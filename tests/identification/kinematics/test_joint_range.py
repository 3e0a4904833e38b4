"""Ranges of joints in files: converted by hand."""

from __future__ import annotations

import numpy as np

from identification.kinematics.counting import joint_range, range_of

TYPES = ("revolute", "prismatic", "revolute")
POSTURES = np.array([[np.pi / 6.0, 12.5, -1.0], [-np.pi / 3.0, 200.0, -0.5]])
DEGREES = [[-60.0, 30.0], [-57.2957795, -28.6478898]]


def test_slides_are_in_millimetres_under_their_own_key() -> None:
    assert joint_range(POSTURES, TYPES) == {"joint_range_deg": DEGREES, "joint_range_mm": [[12.5, 200.0]]}
    assert joint_range(POSTURES[:, :1], TYPES[:1]) == {"joint_range_deg": DEGREES[:1]}
    assert joint_range(POSTURES[:, 1:2], TYPES[1:2]) == {"joint_range_mm": [[12.5, 200.0]]}


def test_what_was_written_is_read() -> None:
    for joints in ([0, 1, 2], [0], [1], [2, 1]):
        types = [TYPES[j] for j in joints]
        found = range_of(joint_range(POSTURES[:, joints], types), types)
        assert found is not None
        np.testing.assert_allclose(found, [POSTURES[:, joints].min(axis=0), POSTURES[:, joints].max(axis=0)], rtol=1e-8)


def test_older_files_have_all_joints_under_one_key() -> None:
    older = {"joint_range_deg": [DEGREES[0], list(np.degrees([12.5, 200.0])), DEGREES[1]]}
    found = range_of(older, TYPES)
    assert found is not None
    np.testing.assert_allclose(found, [[-np.pi / 3.0, 12.5, -1.0], [np.pi / 6.0, 200.0, -0.5]], rtol=1e-8)


def test_what_is_not_there_is_not_known() -> None:
    assert range_of({}, TYPES) is None
    assert range_of({"joint_range_deg": DEGREES}, TYPES) is None
    assert range_of({"joint_range_deg": DEGREES}, ("revolute",)) is None
