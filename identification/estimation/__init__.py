"""From measurements to parameters with their uncertainty, for one data set or for many.

`estimate` is the only entry point for one data set, `estimate_batch` for many data sets on one plan, and
`without_outliers` repeats any fit until it explains every row that is left.
"""

from identification.estimation.estimate import estimate, estimate_batch, without_outliers
from identification.estimation.result import Identification

__all__ = ["Identification", "estimate", "estimate_batch", "without_outliers"]
