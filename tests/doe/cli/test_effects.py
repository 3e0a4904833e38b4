"""`armcal effects` as a user runs it."""

from __future__ import annotations

from tests.doe.cli.conftest import Folder


def test_the_list_and_one_effect(folder: Folder) -> None:
    listed = folder.armcal("effects", "--json")
    assert listed.code == 0, listed.err
    by_name = {found["name"]: found for found in listed.data["effects"]}
    assert by_name["thermal_growth"]["parameters"] == [{"key": "a_per_K", "unit": "1/K", "typical": 2e-5}]
    assert by_name["link_bending"]["arms"] == ["planar"]
    shown = folder.armcal("effects", "transmission_ripple:2")
    assert 'name = "transmission_ripple"' in shown.out
    assert "0.25 to 2000" in shown.out
    everything = folder.armcal("effects").out
    assert [name for name in by_name if f"  {name}" not in everything] == []
