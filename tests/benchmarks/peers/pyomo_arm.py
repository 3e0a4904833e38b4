"""A planar arm as Pyomo.DoE wants it: every run of the plan in one model, angles as inputs, positions as outputs."""

from __future__ import annotations

import numpy as np
import pyomo.environ as pyo
from pyomo.contrib.parmest.experiment import Experiment

from tests.benchmarks.peers.geometry import Planar

ONE = 1.0  # what a parameter that is right has: finite differences are relative to it, so that it must not be zero


class ArmExperiment(Experiment):
    """postures : (m, n) [rad] where the search starts"""

    def __init__(self, arm: Planar, postures: np.ndarray) -> None:
        self.arm, self.postures = arm, postures

    def get_labeled_model(self) -> pyo.ConcreteModel:
        runs, links = self.postures.shape
        model = pyo.ConcreteModel()
        model.runs, model.links = pyo.RangeSet(0, runs - 1), pyo.RangeSet(0, links - 1)
        limits = list(zip(self.arm.lower.tolist(), self.arm.upper.tolist(), strict=True))
        model.q = pyo.Var(
            model.runs, model.links, bounds=lambda _, i, j: limits[j], initialize=lambda _, i, j: self.postures[i, j]
        )
        model.length = pyo.Var(model.links, initialize=ONE)
        model.offset = pyo.Var(model.links, initialize=ONE)
        model.length.fix()
        model.offset.fix()
        for name, function in (("x", pyo.cos), ("y", pyo.sin)):
            self._add_coordinate(model, name, function)
        self._label(model)
        return model

    def _add_coordinate(self, model: pyo.ConcreteModel, name: str, function) -> None:
        lengths = self.arm.lengths.tolist()

        def tip(model: pyo.ConcreteModel, i: int):
            """Parameters in units that move the tip by a millimeter."""
            angles = [sum(model.q[i, k] for k in range(j + 1)) for j in model.links]
            offsets = [(model.offset[j] - ONE) / lengths[j] for j in model.links]
            return sum((lengths[j] + model.length[j] - ONE) * function(angles[j] + offsets[j]) for j in model.links)

        measured = pyo.Var(model.runs, initialize=lambda model, i: pyo.value(tip(model, i)))
        model.add_component(name, measured)
        rule = pyo.Constraint(model.runs, rule=lambda model, i: measured[i] == tip(model, i))
        model.add_component(f"{name}_rule", rule)

    @staticmethod
    def _label(model: pyo.ConcreteModel) -> None:
        outputs = [component[i] for component in (model.x, model.y) for i in model.runs]
        unknown = [component[j] for component in (model.length, model.offset) for j in model.links]
        inputs = [model.q[i, j] for i in model.runs for j in model.links]
        for name, entries in (
            ("experiment_outputs", [(variable, None) for variable in outputs]),
            ("measurement_error", [(variable, 1.0) for variable in outputs]),
            ("unknown_parameters", [(variable, pyo.value(variable)) for variable in unknown]),
            ("experiment_inputs", [(variable, None) for variable in inputs]),
        ):
            suffix = pyo.Suffix(direction=pyo.Suffix.LOCAL)
            model.add_component(name, suffix)
            suffix.update(entries)
