"""Names that may be meant: misspelt ones, and parts of them."""

import pytest

from identification import library
from identification.errors import close_names

KEYS = ("name", "kind", "links_mm", "joint_limits_deg", "measurement", "gravity", "effects", "calibration", "sigma_mm")


@pytest.mark.parametrize(
    ("word", "names"),
    [
        ("link_mm", ["links_mm"]),
        ("LINKS_MM", ["links_mm"]),
        ("links", ["links_mm"]),
        ("limits", ["joint_limits_deg"]),
        ("joint_limits_rad", ["joint_limits_deg"]),
        ("jointlimits", ["joint_limits_deg"]),
        ("measurment", ["measurement"]),
        ("sigma", ["sigma_mm"]),
        ("base", []),  # and not `name`
        ("instrument", []),  # and not `measurement`
        ("description", []),  # and not `calibration`
        ("x", []),
        ("", []),
        ("_", []),
        ("a" * 100_000, []),
        ("backlsh", ["backlash"]),
        ("bending", ["link_bending"]),
        ("noise", ["joint_noise", "reach_noise", "time_noise"]),
        ("lengthoffset", ["length_offset"]),
        ("joint", []),  # too many
        ("wave", []),
    ],
)
def test_keys_and_effects(word: str, names: list[str]) -> None:
    assert close_names(word, [*KEYS, *library()]) == names


def test_numbers_are_kept() -> None:
    assert close_names("length_error:9", [f"length_error:{j}" for j in range(1, 7)]) == []
