"""Monte Carlo studies: what plans, models and estimators are worth, by simulation; and the paper's own, reproduced."""

from doe.studies.monte_carlo.cells import Fitted, Study, Truth, load_study
from doe.studies.monte_carlo.study import StudyResult, cells, dft_postures, run_study

__all__ = ["Fitted", "Study", "StudyResult", "Truth", "cells", "dft_postures", "load_study", "run_study"]
