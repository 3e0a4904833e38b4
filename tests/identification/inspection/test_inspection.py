"""What `inspect` says of data: each fault on purpose has its sentence, and good data have none."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from identification import Arm, DHRow, Measurements, Model, chain_of, estimate
from identification.estimation.repeats import NoiseFloor
from identification.gap.library_prior import library_prior
from identification.inspection.inspection import inspect, other_frame, sufficiency
from identification.inspection.readings import read_differently
from identification.instruments.tracker import Tracker
from identification.kinematics.chain import BASE
from identification.kinematics.frames import rotation_about
from identification.validate import validate
from tests.identification.exponentials import Exponentials, drawing
from tests.identification.kinematics.test_spatial import printed

LENGTHS = np.array([500.0, 400.0, 200.0])
ARM = Arm(LENGTHS, lower=np.full(3, -2.5), upper=np.full(3, 2.5))


def data(m: int = 40, base: complex = 0.0, zero: float = 0.0, still: bool = False) -> Measurements:
    """Measurements of an arm with errors of drawing and noise, written with complex numbers."""
    generator = np.random.default_rng(21)
    q = generator.uniform(-2.4, 2.4, (m, 3))
    q[:, 2] = 0.3 if still else q[:, 2]
    theta = np.cumsum(q + np.array([0.0, 0.004 + zero, -0.003]), axis=1)
    z = np.exp(1j * theta) @ (LENGTHS + np.array([0.5, -0.4, 0.3])) + base
    z += 0.05 * (generator.standard_normal(m) + 1j * generator.standard_normal(m))
    return Measurements(q, np.column_stack([z.real, z.imag]))


def test_good_data_have_no_problem() -> None:
    found = inspect(ARM, data())
    read = found.to_json()
    assert (found.problems, read["rows"], read["postures"]) == ((), 40, 40)
    assert 1.0 < read["rms_drawing_mm"] < 5.0
    assert read["rms_fitted_mm"] == pytest.approx(0.05 * np.sqrt(2.0 * (1.0 - 6.0 / 80.0)), rel=0.3)
    assert any("no posture is repeated" in note for note in found.notes)
    assert "repeats scatter by" not in str(inspect(ARM, replace(data(), sigma=np.full(40, 0.05))).document("a", "b"))


@pytest.mark.parametrize("unit", [np.radians(1.0), 1.0])
def test_repeats_scatter_in_millimetres_or_are_not_said(unit: float) -> None:
    """Noise of 0.05 mm per coordinate is 0.07 mm at a point; what is in other units, or too few rows, say nothing."""
    rows = data().rows(np.tile(np.arange(10), 4))
    z = 0.05 * np.random.default_rng(5).standard_normal(rows.positions.shape)
    found = inspect(ARM, replace(rows, postures=unit * rows.postures, positions=rows.positions + z)).to_json()
    assert found["repeats_mm"] == (pytest.approx(0.05 * np.sqrt(2.0), rel=0.25) if unit == 1.0 else None)
    assert inspect(ARM, rows.rows(np.repeat([0, 1], 5))).to_json()["close_repeats_mm"] is None


def test_each_fault_has_its_sentence() -> None:
    good, turned = data(), data().postures
    beyond = np.flatnonzero(turned[:, 1] < -2.0)
    turned = turned + 2.0 * np.pi * np.isin(np.arange(40), (3, 4, 5))[:, None] * [0, 0, 1]
    said = f"{len(beyond)} of 40 postures lie outside the joint limits, the first in row {beyond[0] + 1}: joint 2 at "
    rough = replace(few := data(6), positions=few.positions + np.random.default_rng(1).normal(0.0, 60.0, (6, 2)))
    for arm, rows, start, end in (
        (ARM, replace(good, postures=good.postures * [1, 1, -1]), "it looks as if joint 3 turns the other way: ", ""),
        (ARM, data(zero=0.5), "zeros differ from the drawing's: 28.9 deg at joint 2", ""),  # 0.004 and 0.5 rad
        (replace(ARM, lower=np.array([-2.5, -2.0, -2.5])), good, said, "allowed -114.592 to 143.239"),
        (
            ARM,
            replace(good, postures=turned),
            "3 of 40 postures lie outside the joint limits, the first in row 4: joint 3",
            "; joint 3 would be within them after whole turns (360 deg): count these readings from the drawing's zero",
        ),
        (ARM, replace(good, postures=np.radians(good.postures)), "it looks as if the joint angles are in radians", ""),
        (ARM, good.rows([*range(40), 5]), "1 of 41 rows is an exact copy of another (row 41 of row 6); ", ""),
        (replace(ARM, chain=np.array([500.0, 100.0, 200.0])), good, "the drawing is", ""),
        (ARM, rough, "the drawing is ", ": check lengths and columns"),  # joint 2 -5.3 deg, give or take as much
    ):
        (sentence,) = inspect(arm, rows).problems
        assert sentence.startswith(start)
        assert sentence.endswith(end)


def test_what_the_data_cannot_say() -> None:
    found, rows = inspect(ARM, data(still=True)), data()
    both = inspect(ARM, replace(rows, postures=rows.postures * [1.0, 0.01, 0.01]))
    assert "joint 3 hardly moves: its own errors cannot be seen" in found.notes
    assert "joints 2, 3 hardly move: their own errors cannot be seen" in both.notes
    assert any(note.startswith("not estimable separately: ") for note in found.notes)
    few = inspect(ARM, data(m=2))
    assert few.fit is None
    assert "too few rows for a fit of the geometry" in few.problems


ROWS = ((0.0, np.pi / 2.0, 350.0), (-400.0, 0.0, 0.0), (-300.0, np.pi / 2.0, 0.0))  # a, alpha, d


def points(q: np.ndarray, tool: np.ndarray, rows: Sequence[tuple[float, float, float]] = ROWS) -> np.ndarray:
    """(m, 3) of an arm of these rows, by 4 x 4 matrices."""
    table = [DHRow(*row) for row in rows]
    return np.array([(np.linalg.multi_dot([*map(printed, table, angles)]) @ [*tool, 1.0])[:3] for angles in q])


def test_the_drawing_leaves_the_same_in_check_identify_and_validate() -> None:
    """Base and measured point fitted to all rows in least squares, by SciPy on a chain of its own; more rows than the
    start of a fit looks at."""
    generator = np.random.default_rng(31)
    q, tool = generator.uniform(-2.0, 2.0, (900, 3)), np.array([60.0, 20.0, 40.0])
    turn = Rotation.from_rotvec([0.1, -0.4, 2.0])
    seen = turn.apply(points(q + np.array([0.0, 0.004, -0.006]), tool)) + np.array([2000.0, -500.0, 700.0])
    rows = Measurements(q, seen + generator.normal(0.0, 0.3, seen.shape))
    without, along = points(q, np.zeros(3)), [points(q, axis) for axis in np.eye(3)]

    def left(p: np.ndarray) -> np.ndarray:
        there = without + sum(x * (one - without) for x, one in zip(p[6:], along, strict=True))
        return (rows.positions - Rotation.from_rotvec(p[:3]).apply(there) - p[3:6]).ravel()

    best = least_squares(left, [0.1, -0.4, 2.0, 2000.0, -500.0, 700.0, *tool], xtol=1e-14, ftol=1e-14)
    of_drawing = pytest.approx(np.sqrt(2.0 * best.cost / len(q)), rel=1e-7)
    arm = Arm(chain_of([DHRow(*row) for row in ROWS]))
    fitted = estimate(Model(arm), rows)
    assert (inspect(arm, rows).data["rms_drawing_mm"], fitted.rms_before) == (of_drawing, of_drawing)
    assert validate(fitted.calibrated_arm(), rows).nominal.rms == of_drawing


def test_two_reflectors_changed_for_half_of_the_rows() -> None:
    """Swapped, each row is half of their distance off, however the geometry is fitted: 15 mm of 30 mm."""
    generator = np.random.default_rng(43)
    q, marker = generator.uniform(-2.0, 2.0, (80, 3)), np.array(["a", "b"])[np.arange(80) % 2]
    one, two = (points(q, np.array(tool)) for tool in ([60.0, 15.0, 40.0], [60.0, -15.0, 40.0]))
    seen = np.where((marker == "b")[:, None], two, one) + generator.normal(0.0, 0.05, (80, 3))
    arm = Arm(chain_of([DHRow(*row) for row in ROWS]))
    assert inspect(arm, Measurements(q, seen, marker=marker)).problems == ()
    swapped = np.where(np.arange(80) < 40, marker, np.where(marker == "a", "b", "a"))
    found = inspect(arm, Measurements(q, seen, marker=swapped))
    assert 14.0 < found.fit.rms_after < 16.0
    (said,) = found.problems
    assert "no geometry explains these rows: look for columns, units, rows or markers that are mixed up, or an" in said
    (unnamed,) = inspect(arm, Measurements(q, seen)).problems
    assert "several reflectors without a column marker" in unnamed
    loose = replace(arm, sigma=15.0)  # an instrument as bad as that
    assert not any(
        "no geometry" in problem for problem in inspect(loose, Measurements(q, seen, marker=swapped)).problems
    )


def test_a_base_that_stands_elsewhere() -> None:
    """Known to stand somewhere, found 60 degrees and 500 mm from there; a base that is left out is nowhere wrong."""
    generator = np.random.default_rng(2)
    truth, q = Exponentials(generator), generator.uniform(-2.0, 2.0, (60, 6))
    data = Measurements(q, truth.poses(q)[:, :3, 3] + 0.05 * generator.standard_normal((60, 3)))
    away = truth.base.copy()
    away[:3, :3] = rotation_about([0.0, 1.0, 0.0], np.radians(60.0)) @ away[:3, :3]
    away[2, 3] += 500.0
    chain = replace(drawing(), base=away, settled=frozenset({BASE}))

    def noted(arm: Arm) -> list[str]:
        return other_frame(arm, read_differently(arm, data).written)

    (said,) = noted(Arm(chain))
    assert "not in the frame that [base] says: turned by " in said
    turn, shift = (float(said.split(word)[1].split()[0]) for word in ("turned by ", "deg and "))
    assert turn == pytest.approx(60.0, abs=0.5)
    assert shift == pytest.approx(500.0, abs=5.0)
    assert "zero of joint 1" not in said
    assert noted(Arm(replace(chain, base=truth.base))) == noted(Arm(drawing())) == []


# -- are they enough ---------------------------------------------------------------------------------------------------
TWO_LINKS = np.array([500.0, 400.0])
NOISE = 0.05
# two links, a length and a zero for each: 4 unknowns
TWO = Arm(TWO_LINKS, lower=np.full(2, -2.0), upper=np.full(2, 2.0))


def rows(m: int) -> Measurements:
    generator = np.random.default_rng(31)
    q = generator.uniform(-2.0, 2.0, (m, 2))
    z = np.exp(1j * np.cumsum(q, axis=1)) @ (TWO_LINKS + 0.3)
    z += NOISE * (generator.standard_normal(m) + 1j * generator.standard_normal(m))
    return Measurements(q, np.column_stack([z.real, z.imag]))


def expected(measured: Measurements, sigma: float) -> float:
    """[mm] RMS over the joint limits: with the links as complex unknowns the tip is linear in them."""
    columns, poses = (
        np.exp(1j * np.cumsum(q, axis=1))
        for q in (measured.postures, np.random.default_rng(2).uniform(-2.0, 2.0, (20000, 2)))
    )
    covariance = 2.0 * sigma**2 * np.linalg.inv(columns.conj().T @ columns)  # of the complex unknowns
    return float(np.sqrt(np.mean(np.einsum("mi,ij,mj->m", poses, covariance, poses.conj()).real)))


def test_with_few_rows_the_noise_is_the_one_given_or_that_of_repeats() -> None:
    """3 rows leave 2 numbers, which say next to nothing of the noise; 60 rows say it by their residuals."""
    measured, many = rows(3), rows(60)
    known, unknown = (estimate(Model(replace(TWO, sigma=sigma)), measured) for sigma in (NOISE, None))
    given, words, few = sufficiency(known, measured, NoiseFloor())
    assert (given["numbers"], given["parameters"], given["spare_numbers"], few) == (6, 4, 2, True)
    assert words[0][1] == "6 for 4 parameters: 2 left to judge the fit"
    assert given["identifiable"] == ("length of links 1 and 2", "zero of joints 1 and 2")
    repeats = sufficiency(unknown, measured, NoiseFloor(repeats=0.2 * np.sqrt(2.0)))[0]
    fit = estimate(Model(TWO), many)
    left, _, few = sufficiency(fit, many, NoiseFloor())
    assert (left["spare_numbers"], few) == (116, False)
    for keys, source, data, sigma in (
        (given, "sigma", measured, NOISE),
        (repeats, "repeats", measured, 0.2),
        (left, "residuals", many, fit.scatter),
    ):
        assert keys["expected_tip_from"] == source
        assert keys["expected_tip_mm"] == pytest.approx(expected(data, sigma), rel=0.03)  # by 1000 poses, not 20000
    nothing, words, _ = sufficiency(unknown, measured, NoiseFloor())
    assert (nothing["expected_tip_mm"], nothing["expected_tip_from"]) == (None, None)
    assert str(dict(words)["accuracy"]).startswith("not known: needs sigma_mm")


def test_what_is_not_determined_is_listed() -> None:
    """Joint 2 at rest: both links are one stick, whose parts nothing tells."""
    measured = rows(6)
    still = replace(measured, postures=measured.postures * [1.0, 0.0])
    found, words, _ = sufficiency(estimate(Model(replace(TWO, sigma=NOISE)), still), still, NoiseFloor())
    assert (found["identifiable"], found["expected_tip_mm"]) == ((), None)
    assert dict(words)["accuracy"] == "not known: something is not determined"
    assert len(str(dict(words)["does not"]).split("; ")) == 2


def test_what_only_tilts_tell_apart_is_determined_weakly() -> None:
    """All axes upright: the heights of base and reflector move the tip alike. Their sum is known but for the heights of
    joints 2 and 3 between them, 1 mm each by [machining]; each alone is not known at all."""
    chain = chain_of([DHRow(325.0, 0.0, 300.0), DHRow(275.0, 0.0, 0.0), DHRow(0.0, 0.0, 50.0)])
    generator = np.random.default_rng(4)
    q = generator.uniform(-2.0, 2.0, (40, 3))
    flat = np.exp(1j * np.cumsum(q, axis=1)) @ np.array([325.0, 275.0, 40.0 + 10.0j])
    positions = np.column_stack([flat.real, flat.imag, np.full(40, 410.0)]) + NOISE * generator.standard_normal((40, 3))
    measured = Measurements(q, positions)
    found = estimate(Model(Arm(chain, sigma=NOISE)), measured)
    seen, words, _ = sufficiency(found, measured, NoiseFloor())
    columns = found.model.linearize(q, np.array([found.values[name] for name in found.names]))[1].reshape(120, -1)
    rank = np.linalg.matrix_rank(columns / np.linalg.norm(columns, axis=0).clip(1e-9), tol=1e-6)
    count = f"120 for {len(found.names)} parameters ({rank} determined by them, the rest by [machining])"
    assert words[0][1] == f"{count}: {120 - rank} left to judge the fit"
    assert [row["name"] for row in seen["weakly_determined"]] == ["base.z", "tool[1].z"]
    assert seen["identifiable"][:2] == ("base (x, y, rx, ry, rz)", "tool[1] (x, y)")
    rows = seen["weakly_determined"]
    heights = [found.names.index(row["name"]) for row in rows]
    assert [(row["std"], row["unit"]) for row in rows] == [(pytest.approx(found.std[k]), "mm") for k in heights]
    assert min(row["std"] for row in rows) > 100.0
    assert np.sqrt(found.covariance[np.ix_(heights, heights)].sum()) < 2.0 * np.sqrt(2.0)


def test_what_a_prior_held_is_left_out() -> None:
    """A file of `identify --library-prior` has values of more effects than few rows determine: the drawing's fit."""
    arm, measured = replace(TWO, sigma=NOISE), rows(8)
    library = library_prior(arm)
    fit = estimate(Model(library.arm), measured, prior=library.prior)
    assert len(fit.names) > measured.positions.size
    kept = fit.calibration().about(set(fit.names) - set(library.prior.deviations))
    seen = inspect(replace(library.arm, calibration=kept), measured).to_json()
    alone = inspect(arm, measured).to_json()
    assert seen["problems"] == alone["problems"] == ()
    count = f"{len(library.prior.deviations)} values of effects, which a prior held where they were identified"
    assert any(note.startswith(count) for note in seen["notes"])
    assert seen["rms_fitted_mm"] == pytest.approx(alone["rms_fitted_mm"], rel=1e-6)


@pytest.mark.parametrize("orientations", [False, True])
def test_a_table_of_the_other_convention_is_named(orientations: bool) -> None:
    """Rows as printed, each a turn about x, a shift along it, a turn about z and a shift along that: modified. Without
    noise, and nothing is said of the right one: less of rounding is no better reading."""
    rows = [(0.0, 0.0, 380.0), (30.0, -np.pi / 2.0, 0.0), (440.0, 0.0, 435.0)]
    q, frames = np.random.default_rng(2).uniform(-1.5, 1.5, (40, 3)), []
    for angles in q:
        frames.append(np.eye(4))
        for (a, alpha, d), angle in zip(rows, angles, strict=True):
            across, along = np.eye(4), np.eye(4)
            across[:3, :3], across[0, 3] = Rotation.from_rotvec([alpha, 0.0, 0.0]).as_matrix(), a
            along[:3, :3], along[2, 3] = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix(), d
            frames[-1] = frames[-1] @ across @ along
    turned, seen = np.array(frames)[:, :3, :3], np.array(frames) @ [40.0, 20.0, 90.0, 1.0]
    chains = [chain_of([DHRow(*row) for row in rows], convention) for convention in ("modified", "standard")]
    arms = [Arm(replace(chain, instrument=Tracker(100.0 if orientations else None))) for chain in chains]
    data = Measurements(q, seen[:, :3], orientations=turned if orientations else None)
    right, wrong = (inspect(arm, data).problems for arm in arms)
    assert right == ()
    (said,) = wrong
    assert said.startswith("it looks as if the [[dh]] table is of the modified convention: the drawing then leaves ")
    assert said.endswith('; write convention = "modified"')
    (swapped,) = inspect(arms[0], replace(data, postures=q[:, [1, 0, 2]])).problems
    assert swapped.startswith("it looks as if columns of joints 1 and 2 are swapped")  # not the orientations
