"""What the model of an arm offers to designs of its calibration; `doe.problem.model` says what each member means.

More errors are possible in a chain than measurements distinguish. With a sigma each is held by the prior of its
machining, as `identify` holds it, and the criterion is that of the posterior; without one the design is for a minimal
set. A measured point that the arm does not know is assumed beside the last axis, since on it the last joint shows
nothing. The base stays where the arm has it, at the origin where it is not known: no criterion that a change of frame
does not matter to depends on it.

A contact ties the posture: the measured point is on a sphere or a plane. Such postures form a surface in the space of
joints, on which no solver for free postures can move; so random postures are led onto it by Newton's method (the
shortest step that closes the gap, over and over), and plans are chosen from those, as from any list. Links and stylus
stay outside.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arm import Arm
from identification.arrays import Array
from identification.errors import InputError
from identification.kinematics.chain import BASE, TOOL, KinematicChain
from identification.kinematics.frames import pose
from identification.measurements import BY_ORDER, POINT, REMEMBERED, Conditions, Measurements
from identification.model import Model
from identification.model.placed import PRACTICAL, led_to_contact, minimal, of_positions, tip_jacobian
from identification.workspace import circle_across

if TYPE_CHECKING:
    from identification.files.measurement import Plan
    from identification.gap.detectability import Detectability
    from identification.gap.library_prior import LibraryPrior

CHOICES = 2000  # postures that touch to choose from, as for robust designs
TOUCHES = 1e-6  # [mm] how near is on the surface


class ArmModel(Model):
    """The model of an arm, all of its measured points read at every posture: d is that of one times their number."""

    dimension = property(lambda self: self.arm.chain.coordinates * self.points_read)  # d per posture, point by point
    lower, upper = property(attrgetter("arm.lower")), property(attrgetter("arm.upper"))  # (n,) limits [rad, mm]

    def symbolic_position(self, q: ca.SX, p: ca.SX) -> ca.SX:
        """(d,) coordinates [mm] at a posture (n,) and parameters (p,), under conditions of which nothing is said."""
        at, chain, each = self._columns, self.arm.chain, []
        conditions = ca.SX(ca.DM(Conditions().table(at, np.zeros((1, self.joints)), self.arm.payload)[0]))
        if "past" in at:
            conditions[at["past"]] = ca.vec(ca.repmat(q.T, REMEMBERED, 1))
        for point in range(self.points_read):
            if self.points_read > 1:  # else the column may be that of the target that is touched, of which none is said
                conditions[at["marker"]] = point
            if "orientation" in at:
                tip = chain.frames(q, self.geometry)[-1]
                conditions[at["orientation"]] = ca.vec(chain.measured(tip, self.geometry, ca.SX(point)).axes.T)
            *symbols, position = self.symbols
            each += ca.substitute([position], symbols, [q, ca.densify(conditions), p])  # axes have zeros
        return ca.vertcat(*each)

    # -- what constraints need -------------------------------------------------------------------------------------
    constraints = property(attrgetter("arm.constraints"))  # those of the arm file
    space = property(attrgetter("arm.dimension"))  # 2 in the plane, 3 in space
    cell = property(attrgetter("arm.cell"))  # bodies of the arm and around it; None: nothing is known of any

    # (n, 3) directions of the joints, each in its own frame
    joint_axes = property(lambda self: np.array([joint.axis for joint in self.arm.chain.joints]))

    @cached_property
    def joint_frames(self) -> Callable[[Array], Array]:
        """Of postures (m, n) the frames (m, n + 2, 4, 4) [mm] as best known, in that of the base: base, each joint
        after it moved, and the tip's with the first measured point as its origin."""
        placed = self.arm.chain.frames_at(self.geometry)

        def at(postures: Array) -> Array:
            frames = placed(postures)
            frames[..., -2, :3, 3] = frames[..., -1, :3, 3]
            return frames[..., :-1, :, :]

        return at

    def measured_already(self, plan: Plan) -> tuple[Array, Array]:
        """Postures (k, n) of the runs that a plan carried out, or measurements, stand for, and (k, d) [mm^2] by how
        much the variance of each coordinate exceeds that of the arm, infinite where none was read: of measurements at
        each posture as many runs as a point was read there. Raises `InputError` for points that the arm lacks."""
        points, column = [*self.arm.chain.tools], self.arm.chain.point_column
        names, sigma, columns = plan.cells.get(column), plan.conditions["sigma"], {*plan.cells}
        excess = np.zeros(len(plan)) if self.sigma is None or sigma is None else sigma**2 - self.sigma**2
        unread = np.zeros(self.arm.chain.coordinates)  # of a point
        if columns & {"x_mm", "x_m"} and not columns & {"rx_deg", "rx_rad", "qw"}:
            unread[self.arm.dimension :] = np.inf
        if not names:
            return plan.postures, np.tile(excess[:, None] + unread, len(points))
        if len(points) == 1:  # whatever the file calls it
            points = [Counter(names).most_common(1)[0][0]]
            if others := len(names) - names.count(points[0]):
                which = f"{others} of {len(names)} rows are not of {points[0]} and do not count"
                warnings.warn(f"{column}: {which}; name all measured points in the arm file", stacklevel=2)
        postures, places = np.unique(plan.postures.round(9), axis=0, return_inverse=True)
        runs, read = dict[tuple[int, int], Array](), Counter[tuple[int, str]]()
        for place, name, more in zip(places.reshape(-1).tolist(), names, excess, strict=True):
            if name in points:
                run = runs.setdefault((place, read[place, name]), np.full((len(points), len(unread)), np.inf))
                run[points.index(name)] = more + unread
                read[place, name] += 1
            elif len(points) > 1:
                raise InputError.unknown(f"{column}: unknown name", name, points)
        return postures[[place for place, _ in runs]], np.reshape([*runs.values()], (len(runs), -1))

    def symbolic_points(self, q: ca.SX) -> tuple[list[ca.SX], list[ca.SX], ca.SX]:
        """Base and joints, and all measured points (space,) [mm] at a posture (n,), in the frame of the base, and the
        tip's axes (3, 3)."""
        chain, (*frames, tip, _) = self.arm.chain, self.arm.chain.in_base(q, self.geometry)
        measured = [chain.measured(tip, self.geometry, ca.SX(k)).point(ca.SX(3, 1)) for k in range(self.points_read)]
        joints = [frame.origin for frame in frames[chain.first_point :]]
        return [each[: self.space] for each in joints], [each[: self.space] for each in measured], tip.axes

    @property
    def other_points(self) -> Array:
        """(k - 1, 3) [mm] from the first of k measured points to the others, in the frame of the tip."""
        places = np.array([place[:3, 3] for place in self.arm.chain.tools.values()])
        return np.asarray(places[1:] - places[0])

    # -- before a plan is made -------------------------------------------------------------------------------------
    def placed(self) -> ArmModel:
        """The same with its measured points in place, and without a sigma for a minimal set of parameters. Raises
        `InputError` for contacts with a surface whose place is not known; warns of points that are assumed."""
        model = replace(self, arm=replace(self.arm, chain=with_points(self.arm.chain, contacts=True)))
        return design_model(minimal(model)) if model.sigma is None and model.prior else model

    # whether the instrument allows some postures only, as a probe that touches a surface
    tied = property(attrgetter("arm.chain.instrument.contact"))

    def tied_postures(
        self, lower: Array, upper: Array, units: Array, feasible: Callable[[Array], NDArray[np.bool_]]
    ) -> Array:
        """(N, n) random postures at which the measured point is on the surface and all else of the arm outside. Raises
        `InputError` where there are hardly any; warns of what plans are of;  lower, upper : (n,) limits;  units : (n,)
        what counts as a radian;  feasible : which postures are allowed"""
        chain = self.arm.chain
        generator, kept = np.random.default_rng(0), np.zeros((0, len(chain)))
        batch, batches = 4000, 10  # effort: random postures that are led to the surface at once, and how often
        for _ in range(batches):
            anywhere = generator.uniform(lower, upper, (batch, len(chain)))
            targets = len(chain.instrument.targets)  # as many postures for each
            target = np.arange(batch, dtype=float) % targets if targets else None
            q = led_to_contact(self, anywhere, np.zeros(1), units, target)
            q = q[np.all((q >= lower) & (q <= upper), axis=1) & (np.linalg.norm(self.position(q), axis=1) < TOUCHES)]
            q = q[self.clear_of_surface(q)]
            kept = np.concatenate([kept, q[feasible(q)]])[:CHOICES]
            if len(kept) == CHOICES:
                break
        if len(kept) < 100:  # with fewer a plan has no choice
            reason = f"reached within limits and constraints from {len(kept)} of {batch * batches} random postures"
            side = ", its normal on the side of the arm" if "normal" in chain.instrument.keys else ""
            raise InputError(f"instrument: the {chain.instrument.kind} is {reason}, allowed: one within reach{side}")
        what = f"{len(kept)} random postures that touch the {chain.instrument.kind} by the best known model"
        warnings.warn(f"instrument: plans are chosen from {what}, and bounds hold for these", stacklevel=2)
        return kept

    def plan_columns(self, postures: Array) -> dict[str, list[str]]:
        """What a plan says of its postures (m, n) besides: the target that each touches, where there are several."""
        instrument = self.arm.chain.instrument
        if not (instrument.contact and instrument.targets):
            return {}
        points = of_positions(self).position(postures)
        apart = [np.linalg.norm(points - place, axis=1) for place in instrument.targets.values()]
        return {instrument.target: np.array([*instrument.targets])[np.argmin(apart, axis=0)].tolist()}

    def clear_of_surface(self, postures: Array) -> NDArray[np.bool_]:
        """(m,) True where links and stylus, straight from joint to joint and to the measured point, are outside the
        surface that the point touches; of a cup nothing is known but its center."""
        if (chain := self.arm.chain).instrument.own_targets:
            return np.ones(len(postures), dtype=bool)
        points = self.points(postures) @ chain.base[:3, :3].T + chain.base[:3, 3]
        # of a segment the nearest point to a sphere is that to its center, to a plane an end
        start, along = points[:, :-1], np.diff(points, axis=1)
        share = -np.sum(start * along, axis=-1) / np.maximum(np.sum(along**2, axis=-1), 1e-300)
        points = np.concatenate([points, start + np.clip(share, 0.0, 1.0)[..., None] * along], axis=1)
        own = np.array([self.best_known[p.name] for p in chain.instrument.parameters])
        return np.asarray(np.all(chain.instrument.readings(points, own)[..., 0] > -2.0 * TOUCHES, axis=1))

    # -- what accuracy is about ------------------------------------------------------------------------------------
    points_read = property(lambda self: len(self.arm.chain.tools))  # number of measured points

    def _of_each_point(self, model: Model, postures: Array, conditions: Conditions) -> Array:
        """(m, d, p) derivative of the coordinates of all measured points, at the parameters' best known values."""
        if self.points_read == 1:
            return model.jacobian(postures, None, conditions)
        points = (np.full(len(postures), float(k)) for k in range(self.points_read))
        return np.concatenate([model.jacobian(postures, None, replace(conditions, marker=k)) for k in points], axis=1)

    def tip_jacobian(self, postures: ArrayLike) -> Array:
        """(k, P, c, p) derivative of the P measured points' positions at postures (k, n), whatever is read of them: x
        and y, or x, y and z [mm]."""
        if of_positions(self) is not self:  # something else is read
            return tip_jacobian(self, postures)[:, None]
        jacobian = self._of_each_point(self, np.atleast_2d(np.asarray(postures, dtype=float)), Conditions())
        return jacobian.reshape(len(jacobian), self.points_read, self.arm.chain.coordinates, -1)[:, :, POINT]

    def predicted_95(self, measurements: Measurements) -> tuple[Array, Array | None]:
        """(m, d) positions of a calibrated arm at measured postures, and how far their 95 % intervals reach by the
        covariance of its calibration; None: it has none."""
        from identification.estimation.uncertainty import quantile_95

        positions, jacobian = self.linearize(measurements.postures, self.values, measurements.conditions)
        if (calibration := self.arm.calibration) is None or calibration.covariance is None:
            return positions, None
        place = [self.names.index(name) for name in calibration.parameter_names]
        columns = jacobian[..., place] * quantile_95(calibration.freedom)
        return positions, np.sqrt(np.einsum("mdp,pq,mdq->md", columns, calibration.covariance, columns, optimize=True))

    # -- what may be missing ---------------------------------------------------------------------------------------
    def missing_effects(self, names: Sequence[str] | None, fastest: float) -> LibraryPrior:
        """Effects that the arm may have too, with their sizes;  names : of them, None: all;  fastest : order of the
        fastest wave of an error curve. Raises `InputError` for unknown names."""
        from identification.gap.library_prior import library_prior

        return library_prior(self.arm, names=names, fastest=fastest)

    def with_effects(self, missing: LibraryPrior) -> tuple[ArmModel, Mapping[str, float], Callable[[Array], float]]:
        """The model with these effects in it, each posture's own error in its sigma; the standard deviations of their
        parameters; and the mean square [mm^2] of the tip's distance at postures (k, n) that no plan can lower."""
        own_error = missing.prior.own_error
        model = ArmModel(replace(missing.arm, sigma=float(np.hypot(self.sigma or 0.0, own_error))), self.held)

        def beyond(poses: Array) -> float:
            levers = of_positions(model).joint_levers(poses)[:, POINT]
            return float(np.mean(np.einsum("kdj,j->k", levers**2, missing.faster))) + levers.shape[1] * own_error**2

        return model, missing.prior.deviations, beyond

    def rival_effects(self) -> tuple[int, ArmModel, tuple[Array, ...], Array, Callable[[Array], Array], Any]:
        """The fields of `doe.discrimination.design.EffectLibrary`: what a plan distinguishes, the effects of the
        library that an arm can have besides its own, without the rare ones, beside a minimal set of parameters. An
        effect that acts at every joint alike has one size for all of them: that is what is seen first."""
        from identification.gap.blocks import hypotheses

        arm = without_prior(self.arm)
        members = hypotheses(arm, frozenset()).members
        usual = [(b, b.effect) for b in members if b.effect and b.effect.prior == 1.0 and not b.through]
        common = [(block, effect) for block, effect in usual if not effect.chosen]
        shown = [(block, effect) for block, effect in common if not effect.needs & BY_ORDER]
        model = Model(arm.with_effects(*arm.effects, *(effect.spec for _, effect in shown)))
        base, bases = len(Model(arm).parameters), []
        for block, effect in shown:
            columns = [model.parameters.index(parameter.name) - base for parameter in effect.parameters]
            basis = np.zeros((len(model.parameters) - base, len(columns)))
            basis[columns, range(len(columns))] = model.scales[base:][columns]
            bases.append(basis.sum(axis=1, keepdims=True) if block.family else basis)
        weights = np.array([block.weight for block, _ in shown])
        by_rows = (effect.spec for _, effect in common if effect.needs & BY_ORDER)
        ordered = Model(arm.with_effects(*arm.effects, *by_rows))

        def by_order(postures: Array) -> Array:
            """(m, d, p) scaled sensitivities to postures (m, n) that are measured in their order."""
            conditions = Measurements(postures, np.zeros((len(postures), ordered.dimension))).conditions
            return self._of_each_point(ordered, postures, conditions) / ordered.scales

        return base, design_model(model), tuple(bases), weights, by_order, replace(self, arm=arm).detectability

    def detectability(self, plan: Plan) -> Detectability:
        """What measuring a plan could show of every effect of the library, by the payloads, temperatures and directions
        of its file, else by its order; with weights, of as many runs as it has rows, shared out by them."""
        from identification.gap.detectability import detectability

        rows = np.flatnonzero(plan.shares)
        given = {name: np.nan_to_num(values)[rows] for name, values in plan.conditions.items() if values is not None}
        runs = None if plan.weights is None else len(plan) * plan.weights[rows]
        return detectability(without_prior(self.arm), plan.postures[rows], Conditions(**given), runs)

    # -- what theory knows -----------------------------------------------------------------------------------------
    # whether it is a chain of links in a plane, of which Table I of the paper holds
    planar = property(attrgetter("arm.chain.as_in_paper"))

    @property
    def theorem_joints(self) -> tuple[int, ...] | None:
        """Joints (from 0) on which det M depends where the planar theorem holds, that is for all lengths and joint
        offsets of a planar chain: all but the first, and the first too with a base offset; None: it does not hold."""
        if self.closed_form is None or not self.closed_form.exact:
            return None
        return tuple(range(0 if any(effect.name == "base_offset" for effect in self.effects) else 1, self.joints))


def design_model(model: Any) -> Any:
    """The `ArmModel` of an arm, or of its model; any other model as it is."""
    if isinstance(model, Arm):
        return ArmModel(model)
    return model if isinstance(model, ArmModel) or not isinstance(model, Model) else ArmModel(model.arm, model.held)


def without_prior(arm: Arm) -> Arm:
    """An arm with its measured points in place and a minimal set of parameters, as tests for effects see it."""
    model = Model(replace(arm, chain=with_points(arm.chain)))
    return minimal(model, PRACTICAL).arm if model.prior else model.arm


def with_points(chain: KinematicChain, contacts: bool = False) -> KinematicChain:
    """The chain with unknown measured points placed evenly around the last axis, and the center of measured distances
    where the arm file gives it, else in front of the arm.

    contacts : whether they can be planned, at postures that touch. Raises `InputError` if not, and if the place of the
    surface is not known.
    """
    instrument = chain.instrument
    placed = bool(instrument.targets) if instrument.own_targets else not np.array_equal(chain.base, np.eye(4))
    stands = placed or BASE in chain.settled
    if not instrument.reads_positions and not contacts:
        chain.refuse_contacts()
    if (instrument.contact or instrument.own_targets) and not stands:
        keys = sorted(instrument.keys & {"center_mm", "normal", "cups"})
        reason = f"kind {instrument.kind} without {keys[0]}: the place of contact is not known"
        allowed = f"allowed for plans: with {' and '.join(keys)}, or a calibrated arm"
        raise InputError(f"instrument: found {reason}, {allowed}")
    if not instrument.reads_positions and not stands:
        away = 0.5 * chain.reach
        assumed = f"a point {away:.0f} mm in front of the base, on its x axis, is assumed; give instrument.center_mm"
        warnings.warn(f"instrument: the center is not known; {assumed}", stacklevel=2)
        chain = replace(chain, base=pose([-away, 0.0, 0.0]))
    names = [name for name, at in chain.tools.items() if not np.any(at[:3, 3])]
    if TOOL in chain.settled or not names:
        return chain
    beside, away = ", ".join(names) if len(chain.tools) > 1 else "the measured point", 100.0  # [mm] as of most flanges
    across, other = circle_across(chain.end[:3, :3].T @ chain.joints[-1].axis)
    turns = 2.0 * np.pi * np.arange(len(names)) / len(names)
    places = away * (np.cos(turns)[:, None] * across + np.sin(turns)[:, None] * other)
    where = "; ".join(", ".join(f"{x:z.0f}" for x in place) for place in places.tolist())
    assumed = f"{away:g} mm beside the last axis is assumed, at {where} mm in the frame of the tip"
    warnings.warn(f"tool: the place of {beside} is not known; {assumed}", stacklevel=2)
    return replace(chain, tools={**chain.tools, **dict(zip(names, places, strict=True))})
