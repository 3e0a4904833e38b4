"""Parameters and sets of them: order, names, kinds, vectors and mappings."""

import numpy as np
import pytest

from identification.kinematics.parameters import (
    JOINT_OFFSET,
    LENGTH_ERROR,
    Parameter,
    ParameterSet,
    by_joint,
    chain_parameters,
    of_effects,
)

ERRORS = chain_parameters([300.0, 200.0])
SET = ParameterSet(
    [
        ERRORS[0],
        chain_parameters([300.0])[1],
        Parameter("backlash:2.b", "rad", lower=-0.1, upper=0.2, scale=200.0, joint=2),
        ERRORS[1],
    ]
)


def test_arrays_follow_the_order_and_are_read_only() -> None:
    np.testing.assert_array_equal(SET.scales, [1.0, 300.0, 200.0, 1.0])
    np.testing.assert_array_equal(SET.lower, [-np.inf, -np.inf, -0.1, -np.inf])
    np.testing.assert_array_equal(SET.upper, [np.inf, np.inf, 0.2, np.inf])
    for array in (SET.scales, SET.lower, SET.upper):
        assert not array.flags.writeable


def test_vector_and_mapping_are_inverse() -> None:
    values = {"length_error:2": 2.0, "joint_offset:1": 0.1, "of another model": 9.0}
    vector = SET.vector(values)
    np.testing.assert_array_equal(vector, [0.0, 0.1, 0.0, 2.0])
    np.testing.assert_array_equal(SET.vector({}, default=np.nan), np.full(4, np.nan))
    assert SET.mapping(vector) == {
        "length_error:1": 0.0,
        "joint_offset:1": 0.1,
        "backlash:2.b": 0.0,
        "length_error:2": 2.0,
    }
    with pytest.raises(ValueError, match="shorter"):
        SET.mapping(vector[:3])


def test_parameters_of_a_chain() -> None:
    parameters = chain_parameters([260.0, 180.0])
    assert parameters.names == ("length_error:1", "length_error:2", "joint_offset:1", "joint_offset:2")
    assert parameters.kinds == (LENGTH_ERROR, LENGTH_ERROR, JOINT_OFFSET, JOINT_OFFSET)
    assert parameters.units == ("mm", "mm", "rad", "rad")
    np.testing.assert_array_equal(parameters.scales, [1.0, 1.0, 260.0, 180.0])


def test_values_by_joint_and_of_effects() -> None:
    values = {"joint_offset:2": 0.2, "length_error:1": 1.5, "backlash:2.b": 0.01, "joint_offset:1": 0.1}
    np.testing.assert_array_equal(by_joint(values, JOINT_OFFSET), [0.1, 0.2])
    np.testing.assert_array_equal(by_joint(values, LENGTH_ERROR), [1.5])
    assert of_effects(values) == {"backlash:2.b": 0.01}
