"""The result to type in: nominal and corrected value of every length, zero of a joint, frame and effect.

Values are those that a controller or a kinematic table has, not errors. In space they are functions of several
parameters; their standard deviations follow from the covariance by first derivatives (delta method). The corrected
Denavit-Hartenberg table is a complete set of values, none of which is arbitrary.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from identification.arm import Arm, Calibration
from identification.arrays import Array
from identification.estimation.uncertainty import freedom_of, quantile_95
from identification.kinematics.chain import STANDARD, DHRow, KinematicChain
from identification.kinematics.corrected import CorrectedGeometry, Link, corrected, corrected_links, drawn_links
from identification.kinematics.frames import pose, pose_table
from identification.kinematics.parameters import JOINT_OFFSET, JOINT_UNITS, LENGTH_ERROR, Parameter
from identification.model import Model

if TYPE_CHECKING:
    from identification.estimation.result import Identification

STEP = {"mm": 1e-3, "rad": 1e-6}  # of central differences: exact for shifts, to 1e-12 for angles
LINK = "length of the link"
ZERO = "add to the zero of joint {j}: real position = reading + this; or take it off every command"
FRAME = "frame of joint {j} in that of {before}, as a URDF joint's origin: x, y, z, then roll, pitch, yaw"
TURNED_FRAME = (
    "frame of joint {j} in that of {before}: x, y, z, then how it is turned from the drawing about its own x, y and z "
    "axis; its pitch is near 90 deg, where small turns are large changes of roll and yaw"
)
BASE = "pose of the base for the instrument, turned about its own x, y and z axis"
TOOL = "measured point in the frame of the tip"
STANDS = "where the arm stands: type it into the controller only if the measurements are in the controller's own frame"
TURNED = f"zero of joint 1 with how the arm is turned, {STANDS}"
EFFECT = "no value of a controller: armcal compensate takes it off the commands"
UNITS = {"theta": "deg", "d": "mm", "a": "mm", "alpha": "deg", "beta": "deg"}
MEANING = {
    "theta": "offset: what joint {j} adds to its reading, in the table",
    "d": "along the axis of joint {j}",
    "a": "between the axes of joints {j} and {k}",
    "alpha": "between the axes of joints {j} and {k}",
    "beta": "turn about the new y axis after alpha (Hayati), as axes {j} and {k} are nearly parallel; d stays as drawn",
}


@dataclass(frozen=True)
class CorrectedValue:
    """One row, in file units.

    name : in words;  parameter : that it is made of, None: of several
    nominal : None where nothing is drawn;  corrected : None where it is not estimable
    std, low_95, high_95 : None where the value is held, or nothing can be said
    convention : what the value means, and what to do with it
    prior_std : standard deviation before the measurements, None: nothing was known, or not of all that it is made of
    held_by_prior : the measurements say next to nothing about it: they take less than a tenth of its variance
    """

    name: str
    parameter: str | None
    nominal: float | None
    corrected: float | None
    std: float | None
    low_95: float | None
    high_95: float | None
    unit: str
    convention: str
    prior_std: float | None = None
    held_by_prior: bool = False

    @property
    def weak(self) -> bool:
        """Whether the measurements leave more than half of the standard deviation that it had before."""
        return self.std is not None and self.prior_std is not None and self.std > 0.5 * self.prior_std

    def to_json(self) -> dict[str, Any]:
        """An entry of `corrected_values` (identification/files/README.md, "JSON keys")."""
        return dict(vars(self))


Values = Mapping[str, float]  # parameter name -> value [API unit]


class _Quantity(NamedTuple):
    """A value, and its derivatives by parameters, in file units per API unit."""

    name: str
    parameter: str | None
    nominal: float | None
    value: float
    derivatives: Mapping[str, float]
    unit: str
    convention: str
    bounds: tuple[float, float] = (-np.inf, np.inf)


def corrected_values(
    arm: Arm,
    calibration: Calibration | None = None,
    freedom: Collection[float] | None = None,
    unknown: Collection[str] = (),
    factor: Array | None = None,
    seen: Array | None = None,
) -> tuple[CorrectedValue, ...]:
    """What was estimated or differs from the drawing: geometry, then effects.

    calibration : None: the arm's own calibration
    freedom : degrees of freedom of the variances of `calibration.parameter_names`; None: as its provenance says
    unknown : names of parameters that are not estimable
    factor : (p, r) factor of the covariance of `calibration.parameter_names` before the measurements, 0 where
        there is none; None: that of the arm's machining, where all that it says something of was estimated
    seen : (p, p) covariance by which the measurements say next to nothing; None: that of `calibration`
    """
    model, calibration = Model(arm), calibration or arm.calibration or Calibration({})
    values = {**model.fixed, **calibration.values}
    names = {*calibration.parameter_names, *unknown}
    geometry = _planar(arm, values) if arm.chain.planar else _spatial(arm, arm.chain, values, names)
    spread = freedom_of(calibration) if freedom is None else np.array([*freedom], dtype=float)
    prior = model.prior if {*model.prior} <= {*calibration.parameter_names} else {}
    before = np.diag([prior.get(name, 0.0) for name in calibration.parameter_names]) if factor is None else factor
    seen = calibration.covariance if seen is None else seen
    places = {name: k for k, name in enumerate(calibration.parameter_names)}
    quantities = (*geometry, *_effects(model, values))
    rows = (_row(quantity, calibration, places, spread, unknown, before, seen) for quantity in quantities)
    return tuple(row for row in rows if row.std is not None or row.corrected != row.nominal)


def _row(
    quantity: _Quantity,
    calibration: Calibration,
    places: Mapping[str, int],
    freedom: Array,
    unknown: Collection[str],
    before: Array,
    seen: Array | None,
) -> CorrectedValue:
    # parameters that it depends on, by their places in order, and its derivatives by them
    used = sorted((places[name], slope) for name, slope in quantity.derivatives.items() if slope and name in places)
    at = np.array([place for place, _ in used], dtype=np.intp)
    slope = np.array([slope for _, slope in used], dtype=float)
    undetermined, deviation = any(quantity.derivatives.get(name) for name in unknown), np.nan
    if calibration.covariance is not None and at.size and not undetermined:
        deviation = max(float(slope @ calibration.covariance[np.ix_(at, at)] @ slope), 0.0) ** 0.5
    half = float(quantile_95(freedom[at].min(initial=np.inf))) * deviation
    limits = np.clip([quantity.value - half, quantity.value + half], *quantity.bounds)
    figures = [np.nan if undetermined else quantity.value, deviation, *limits]
    value, std, low, high = (float(figure) if np.isfinite(figure) else None for figure in figures)
    about = quantity.name, quantity.parameter, quantity.nominal
    has_prior = bool(slope.size and np.all(np.any(before[at] != 0.0, axis=1)))
    prior = float(np.linalg.norm(before[at].T @ slope)) if has_prior else None
    held = False
    if std is not None and prior is not None and seen is not None:
        held = bool(slope @ seen[np.ix_(at, at)] @ slope > 0.9 * prior**2)
    return CorrectedValue(*about, value, std, low, high, quantity.unit, quantity.convention, prior, held)


# -- what there is -----------------------------------------------------------------------------------------------------
def _planar(arm: Arm, values: Values) -> Iterator[_Quantity]:
    """Lengths and zeros."""
    for j, length in enumerate(arm.lengths.tolist(), start=1):
        name = f"{LENGTH_ERROR}:{j}"
        value = length + values.get(name, 0.0)
        yield _Quantity(f"length of link {j}", name, length, value, {name: 1.0}, "mm", LINK)
    yield from _own_values(arm, values)
    stands = any(spec.name == "base_offset" for spec in arm.effects)
    hidden = arm.chain.instrument.hidden(arm.chain.base)
    for zero in (zero for zero in _zeros(arm, values) if zero.parameter not in hidden):
        yield zero._replace(convention=TURNED) if stands and zero.name == "zero of joint 1" else zero


def _zeros(arm: Arm, values: Values) -> Iterator[_Quantity]:
    """What each joint adds to what is read, as the controller counts: of coupled joints what both add."""
    shares = np.eye(arm.links) if arm.counting is None else arm.counting.matrix
    for j, kind in enumerate(arm.joint_types, start=1):
        p = Parameter(f"{JOINT_OFFSET}:{j}", JOINT_UNITS[kind])
        slopes = {f"{JOINT_OFFSET}:{i}": x * p.to_file for i, x in enumerate(shares[j - 1].tolist(), start=1) if x}
        value = sum(x * values.get(name, 0.0) for name, x in slopes.items())
        alone = p.name if len(slopes) == 1 else None
        yield _Quantity(f"zero of joint {j}", alone, 0.0, value, slopes, p.file_unit, ZERO.format(j=j))


def _effects(model: Model, values: Values) -> Iterator[_Quantity]:
    """Parameters of effects, their names with the settings."""
    for effect in model.effects:
        convention = STANDS if effect.name == "base_offset" else EFFECT
        for p in effect.parameters:
            name, value = f"{effect.label}.{p.short}", values.get(p.name, 0.0) * p.to_file
            bounds = p.lower * p.to_file, p.upper * p.to_file
            yield _Quantity(name, p.name, 0.0, value, {p.name: p.to_file}, p.file_unit, convention, bounds)


# -- in space ----------------------------------------------------------------------------------------------------------
def _spatial(arm: Arm, chain: KinematicChain, values: Values, names: Collection[str]) -> Iterator[_Quantity]:
    """Zeros of the joints, their frames, base and measured points; derivatives by the parameters `names`."""
    yield from _zeros(arm, values)
    drawn, corrected = _tables(chain, {}), _tables(chain, values)
    steps = {p.name: STEP[p.unit] for p in chain.every_parameter if p.name in names and p.kind != JOINT_OFFSET}
    ends = {
        name: [_tables(chain, {**values, name: values.get(name, 0.0) + sign * step}) for sign in (1.0, -1.0)]
        for name, step in steps.items()
    }
    for place, table in corrected.items():
        convention = BASE if place == "base" else TOOL
        if place.startswith("joint "):
            j, frame = int(place.removeprefix("joint ")), FRAME if "roll_deg" in table else TURNED_FRAME
            convention = frame.format(j=j, before="the base" if j == 1 else f"joint {j - 1}")
        for key, value in table.items():
            slopes = {
                name: _nearest(up[place][key] - down[place][key], 0.0, key) / (2.0 * steps[name])
                for name, (up, down) in ends.items()
                if up[place][key] != down[place][key]
            }
            nominal = drawn[place][key] + 0.0 if place.startswith("joint ") else None  # no -0
            axis, _, unit = key.rpartition("_")
            value = value if nominal is None else _nearest(value, nominal, key)
            yield _Quantity(f"{place} {axis}", None, nominal, value, slopes, unit, convention)
    yield from _own_values(arm, values)


def _own_values(arm: Arm, values: Values) -> Iterator[_Quantity]:
    """Of the instrument, where they were estimated: what the arm file says of them is where fits start."""
    if not all(p.name in values for p in arm.chain.instrument.parameters):
        return
    for name, parameter, value, slopes, unit, convention in arm.chain.instrument.own_values(values):
        yield _Quantity(name, parameter, None, value, slopes, unit, convention)


def _tables(chain: KinematicChain, values: Values) -> dict[str, dict[str, float]]:
    """Place -> its numbers in file units: frame of each joint, base, measured points."""
    geometry = CorrectedGeometry(chain, values)
    tables = geometry.tables()
    rows = {f"joint {row.pop('joint')}": row for row in tables["geometry"]}
    for j, joint in enumerate(chain.joints, start=1):
        # pitched by more, a small turn may be a large roll and yaw (gimbal lock)
        if abs(joint.origin[2, 0]) > np.sin(np.radians(85.0)):
            place, drawn = geometry.origin(j), joint.origin[:3, :3]
            turned = pose_table(pose(place[:3, 3], drawn.T @ place[:3, :3]))
            # as drawn is zero, whatever the product of matrices rounds it to
            rows[f"joint {j}"] = {k: round(v, 12) if k.endswith("_deg") else v for k, v in turned.items()}
    hidden = {f"{name.partition('.')[2]}_deg" for name in chain.instrument.hidden(chain.base)}
    hidden |= {key.replace("_deg", "_mm") for key in hidden}
    base = {} if tables["base"] is None else {"base": {k: v for k, v in tables["base"].items() if k not in hidden}}
    tools = {f"tool {name}": place for name, place in tables["tools"].items()}
    return {place: {k: v for k, v in row.items() if k != "name"} for place, row in (rows | base | tools).items()}


def _nearest(value: float, to: float, key: str) -> float:
    """Of an angle [deg] the equal one that is nearest to another."""
    return value - 360.0 * round((value - to) / 360.0) if key.endswith("_deg") else value


# -- the table of Denavit and Hartenberg -------------------------------------------------------------------------------
class Calibrated(NamedTuple):
    """A geometry that was found: `names` (p,) with covariance (p, p) and degrees of freedom (p,), units by name."""

    geometry: CorrectedGeometry
    names: Sequence[str]
    covariance: Array
    freedom: Array
    units: Mapping[str, str]

    @classmethod
    def of(cls, fit: Identification) -> Calibrated:
        """As a fit in space found it."""
        assert fit.geometry is not None
        units = {p.name: p.unit for p in fit.model.geometry_parameters}
        return cls(fit.geometry, fit.names, fit.covariance, fit.uncertainty.freedom, units)

    @classmethod
    def of_arm(cls, arm: Arm) -> Calibrated | None:
        """As a spatial arm's file has it; None without a calibration and its covariance."""
        if (calibration := arm.calibration) is None or arm.chain.planar or calibration.covariance is None:
            return None
        model = Model(arm)
        geometry = CorrectedGeometry(arm.chain, {**model.fixed, **calibration.values})
        units = {p.name: p.unit for p in model.geometry_parameters}
        return cls(geometry, calibration.parameter_names, calibration.covariance, freedom_of(calibration), units)


def dh_values(calibrated: Calibrated, rows: Sequence[DHRow], convention: str = STANDARD) -> tuple[CorrectedValue, ...]:
    """Nominal and corrected numbers of the links between the axes, those as drawn by definition left out.

    rows, convention : of the arm's drawing. Standard deviations by first derivatives of the covariance; a and alpha of
    the modified convention stand in the row of the next joint. Raises `InputError` as `drawn_links`.
    """
    geometry, drawn = calibrated.geometry, drawn_links(rows, convention)
    start, names = dict(geometry.values), calibrated.names
    numbers, nominal = _numbers(geometry.chain, start, drawn), _flat(drawn)
    slopes = np.zeros((len(names), len(numbers)))
    # effects, hundreds with the library, are not in the table
    for row, name in ((row, name) for row, name in enumerate(names) if name in calibrated.units):
        step = STEP.get(calibrated.units[name], 1e-6)
        up, down = (_numbers(geometry.chain, {**start, name: start[name] + s * step}, drawn) for s in (1.0, -1.0))
        slopes[row] = [(up[key] - down[key]) / (2.0 * step) for key in numbers]
    deviations = np.sqrt(np.einsum("pk,pq,qk->k", slopes, calibrated.covariance, slopes).clip(min=0.0))
    half = float(np.min(quantile_95(calibrated.freedom))) if len(names) else np.nan
    shown = []
    for (key, value), std in zip(numbers.items(), deviations.tolist(), strict=True):
        joint, name = key
        row_number = joint + (convention != STANDARD and name in ("a", "alpha", "beta"))
        meaning = MEANING[name].format(j=joint, k=joint + 1)
        figures = (nominal[key], value, std, value - half * std, value + half * std)
        shown.append(CorrectedValue(f"row {row_number} {name}", None, *figures, UNITS[name], meaning))
    return tuple(shown)


def dh_places(calibrated: Calibrated, rows: Sequence[DHRow], convention: str = STANDARD) -> list[tuple[str, Array]]:
    """Beside the values of `dh_values`: the pose of the base (4, 4), and places (3,) of the measured points for the
    last frame of the table, by name. With them the table says what the fit does."""
    drawn, real = drawn_links(rows, convention), calibrated.geometry.real
    links, nominal = corrected_links(real, drawn), corrected_links(calibrated.geometry.chain, drawn)
    base = real.base @ links.first @ np.linalg.inv(nominal.first)
    behind = np.linalg.inv(nominal.last) @ links.last
    tools = [(f"tool {name}", behind[:3, :3] @ place + behind[:3, 3]) for name, place in real.tools.items()]
    return [("base", base), *tools]


def _numbers(chain: KinematicChain, values: Mapping[str, float], drawn: Sequence[Link]) -> dict[tuple[int, str], float]:
    """Joint and name -> number of the corrected table [mm, deg]."""
    return _flat(corrected_links(corrected(chain, values), drawn).links)


def _flat(links: Sequence[Link]) -> dict[tuple[int, str], float]:
    """The numbers that are free: of the first joint theta and d belong to the base, of parallel axes d is as drawn."""
    numbers = {}
    for j, link in enumerate(links, start=1):
        names = ["a", "alpha"] if j == 1 else ["theta", "d", "a", "alpha"]
        names = [name for name in names if name != "d" or link.beta is None] + (
            ["beta"] if link.beta is not None else []
        )
        for name in names:
            value = float(getattr(link, name))
            numbers[j, name] = value if UNITS[name] == "mm" else float(np.degrees(value))
    return numbers
