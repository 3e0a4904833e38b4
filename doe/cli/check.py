"""`armcal check`: inspect measurements before any fit."""

from __future__ import annotations

from doe.cli.common import Answer, CommonOptions, verb
from doe.cli.options import File


@verb("armcal check arm.toml measurements.csv")
def command(common: CommonOptions, arm: File, data: File) -> Answer:
    """Are the measurements what they should be?

    Look at the measurements DATA of ARM before anything is fitted in earnest.

    Rows, ranges against limits, units, repeats, what the drawing leaves after fitting where the arm stands, joints that
    turn the other way, swapped columns, other zeros, mirrored frames, and what can and cannot be found from these data.

    The exit code is 0 also where something is to be put right first: a script reads `ok` of --json.
    """
    from identification.files.arm import load_arm
    from identification.files.arm_chain import urdf_masses
    from identification.files.measurement import load_measurements
    from identification.inspection.inspection import inspect

    loaded = load_arm(arm)
    measurements = load_measurements(data, loaded)
    common.report(0, None, f"trying readings of {len(measurements)} rows, and a fit of the geometry")
    inspection = inspect(loaded, measurements, urdf_masses(arm))
    return Answer(inspection.to_json(), [inspection.document(str(arm), str(data))])
