"""Whether an arm whose file says nothing of gravity sags under it, and what to write into the file then.

The torques of gravity follow from masses and postures; how far a joint gives way to them is one number for each joint,
which takes up the scale of the masses. So masses that are merely in proportion do, and equal ones of 1 kg nearly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from identification.arm import Arm, EffectSpec, Gravity
from identification.errors import InputError
from identification.estimation import Identification, estimate
from identification.estimation.expected_tip import left_out_residuals
from identification.estimation.grouped import gained_squares
from identification.measurements import Measurements, distances
from identification.model import Model
from identification.sessions import with_sessions

G = 9.81  # [m/s^2]
LEVEL = 0.01  # convention: one-sided; it is one question of each data set
WORTH = 0.97  # of the RMS distance: less than 3 % is not worth another table
LEVER = 1e-3  # of the largest torque: an upright first axis has none but rounding


@dataclass(frozen=True)
class Sag:
    """What compliance of the joints explains, with gravity along the last axis of the base.

    masses : (n,) of the links [kg];  from_urdf : as the URDF file has them; False: 1 kg each
    rms_before, rms_after, max_before, max_after : distances [mm] of each posture from where a fit of the geometry to
        all others puts it, without and with compliance;  p_value : one-sided, of no gain
    """

    masses: tuple[float, ...]
    from_urdf: bool
    dimension: int
    rms_before: float
    rms_after: float
    max_before: float
    max_after: float
    p_value: float

    @property
    def recommended(self) -> bool:
        """Whether the arm sags beyond doubt, and by enough to matter."""
        return self.p_value <= LEVEL and self.rms_after <= WORTH * self.rms_before

    @property
    def lines(self) -> tuple[str, ...]:
        """The TOML to add."""
        down = ", ".join(["0.0"] * (self.dimension - 1) + [f"{-G}"])
        return ("[gravity]", f"acceleration_m_s2 = [{down}]", f"link_masses_kg = {[round(m, 4) for m in self.masses]}")

    @property
    def sentence(self) -> str:
        """The recommendation."""
        figures = f"{self.rms_before:.3g} to {self.rms_after:.3g} mm RMS (largest {self.max_before:.3g} to"
        figures += f" {self.max_after:.3g} mm) in postures not fitted, p = {self.p_value:.1g}"
        up = "xyz"[self.dimension - 1]
        masses = (
            "the masses are those of the URDF file"
            if self.from_urdf
            else "1 kg stands for the mass of each link, and the compliances take up the scale; real masses are better"
        )
        return (
            f"the arm sags: compliant joints under gravity take the error from {figures}. Add the lines below to the "
            f"arm file; {masses}. {up} of the base is taken to point up"
        )

    def to_json(self) -> dict[str, Any]:
        """Key `gravity` of `check` (identification/files/README.md, "JSON keys")."""
        lengths = {f"{name}_mm": getattr(self, name) for name in ("rms_before", "rms_after", "max_before", "max_after")}
        named = {"masses_kg": list(self.masses), "masses_from": "urdf" if self.from_urdf else "unit"}
        return {"recommended": self.recommended, **lengths, "p_value": self.p_value, **named, "lines": list(self.lines)}


def sag(arm: Arm, measurements: Measurements, fit: Identification, masses: Sequence[float] | None = None) -> Sag | None:
    """What compliance of the joints explains beyond the geometry of an arm without gravity.

    fit : of the geometry to these measurements;  masses : (n,) of the links [kg] where they are known

    None where the arm has gravity, no joint bears a weight, or the measurements determine the one fit or the other not.
    """
    if arm.gravity is not None:
        return None
    kilograms = np.ones(arm.links) if masses is None else np.asarray(masses, dtype=float)
    down = np.zeros(arm.dimension)
    down[-1] = -G
    heavy = replace(arm, gravity=Gravity(down, kilograms, np.full(arm.links, 0.5)))
    torques = Model(heavy).on_chain(lambda chain: chain.torques)(measurements.postures, measurements.conditions)
    sizes = np.sqrt(np.mean(torques**2, axis=0))
    modelled = {effect.joint for effect in arm.effects if effect.name == "joint_compliance"}
    joints = [j for j in (np.flatnonzero(sizes > LEVER * sizes.max()) + 1).tolist() if j not in modelled]
    soft = heavy.with_effects(*arm.effects, *(EffectSpec("joint_compliance", j) for j in joints))
    try:
        sagging = estimate(Model(with_sessions(soft, measurements)), measurements)
    except InputError:  # too few rows
        return None
    left = [left_out_residuals(one, measurements) for one in (fit, sagging)]
    distances_left = [distances(residuals) for residuals in left if residuals is not None]
    if len(distances_left) < len(left):
        return None
    before, after = distances_left
    return Sag(
        masses=tuple(kilograms.tolist()),
        from_urdf=masses is not None,
        dimension=arm.dimension,
        rms_before=float(np.sqrt(np.mean(before**2))),
        rms_after=float(np.sqrt(np.mean(after**2))),
        max_before=float(before.max()),
        max_after=float(after.max()),
        p_value=gained_squares(before, after, measurements).p_above(),
    )
