"""A simulated small six-axis arm (reach 0.5 m) that sags under gravity, with three reflectors on its flange.

Lines in space in plain numpy (doe/studies/blind/simulator.py); nothing here calls the model. Beside
its geometry the arm has compliant joints, play that gravity pushes to one side, encoders off centre and backlash; every
posture has a further error of its own, which its three reflectors share.
"""

import re
from dataclasses import replace

import numpy as np

from doe.studies.blind.simulator import Drawn, TrueArm, position, session, shift, turn
from identification import Arm, DHRow, Gravity, Measurements, chain_of
from identification.files.urdf import urdf_text

HALF = np.pi / 2.0
TABLE = np.array(  # a, alpha, d
    [(0, HALF, 151.9), (-243.65, 0, 0), (-213.25, 0, 0), (0, HALF, 112.35), (0, -HALF, 85.35), (0, 0, 81.9)]
)
MASSES = np.array([2.0, 3.42, 1.26, 0.8, 0.8, 0.35])
PAYLOAD = 0.6  # [kg] of the reflectors and their plate
UP = np.array([0.0, 0.0, -9.81])
REFLECTORS = ("A", "B", "C")
LOWER, UPPER = np.radians([(-100, -160, -110, -150, -150, -170), (100, -20, 110, 150, 150, 170)])
COMPLIANCE = np.array([0.0, 4e-5, 6e-5, 2e-5, 0.0, 0.0])  # [rad/(N m)]
OTHERS: tuple[Drawn, ...] = (
    ("encoder_eccentricity", 1, {"a": 2e-4, "b": -1e-4}),
    ("encoder_eccentricity", 3, {"a": -2e-4, "b": 2e-4}),
    ("backlash", 2, {"b": 5e-5}),
)


def small_arm(rng: np.random.Generator, *effects: Drawn, compliance: np.ndarray = COMPLIANCE) -> TrueArm:
    """The real arm, its axes 1 mrad and 0.3 mm off, its encoders 3 mrad, with compliance [rad/(N m)] and `effects`."""
    base = shift(np.array([1500.0, -400.0, 200.0]))
    base[:3, :3] = turn(np.array([0.0, 0.0, 0.7]))
    tools = np.array([(40.0, 0.0, 30.0), (-30.0, 35.0, 45.0), (-25.0, -30.0, 60.0)])
    offsets = rng.normal(0.0, 3e-3, 6)
    loads = {"masses": MASSES, "payload": PAYLOAD, "lower": LOWER, "upper": UPPER, "sigma": 0.02}
    sag: list[Drawn] = [("joint_compliance", None, {"c": compliance})]
    return TrueArm.built(
        TABLE, rng, 1e-3, 0.3, offsets=offsets, base=base, tools=tools, effects=[*sag, *effects], **loads
    )


def measured(truth: TrueArm, postures: np.ndarray, rng: np.random.Generator) -> Measurements:
    """Every posture (m, 6) at each reflector in turn, with noise of 0.02 mm of each row and 0.03 mm of each posture."""
    k = len(REFLECTORS)
    run = session(truth, np.repeat(postures, k, axis=0), rng, k)
    shared = np.repeat(0.03 * rng.standard_normal((len(postures), 3)), k, axis=0)
    found = position(truth, run) + shared + 0.02 * rng.standard_normal((len(run.q), 3))
    names = {"marker": np.array(REFLECTORS)[run.marker], "marker_names": REFLECTORS}
    return Measurements(run.q, found, np.arange(len(run.q), dtype=float), directions=run.s, **names)


def random_postures(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 6) within the limits."""
    return rng.uniform(LOWER, UPPER, (count, 6))


def drawn_arm(*, gravity: bool = True) -> Arm:
    """The arm as its maker draws it."""
    limits = zip(LOWER.tolist(), UPPER.tolist(), strict=True)
    rows = [DHRow(a, alpha, d, limits=own) for (a, alpha, d), own in zip(TABLE.tolist(), limits, strict=True)]
    chain = chain_of(rows)
    chain = replace(chain, tools={name: np.zeros(3) for name in REFLECTORS})
    return Arm(chain, sigma=0.02, gravity=Gravity(UP, MASSES, np.full(6, 0.5), PAYLOAD) if gravity else None)


def urdf(*, masses: bool = True) -> str:
    """The drawing as a URDF file, with the mass of each link in it."""
    text = urdf_text(drawn_arm().chain, "small_arm")
    for number, mass in enumerate(MASSES if masses else (), start=1):
        inertial = f'<inertial><mass value="{mass}"/></inertial>'
        text = re.sub(f'<link name="link_{number}" />', f'<link name="link_{number}">{inertial}</link>', text)
    return text
