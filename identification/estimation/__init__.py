"""From measurements to parameters with their uncertainty: `estimate` is the only door for one data set,
`estimate_batch` for many data sets on one plan."""

from identification.estimation.batch import BatchFit, estimate_batch
from identification.estimation.estimate import METHODS, estimate
from identification.estimation.result import Identification

__all__ = ["METHODS", "BatchFit", "Identification", "estimate", "estimate_batch"]
