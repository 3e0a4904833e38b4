"""Monte Carlo studies: how accurate plans, models and estimators are, by simulation."""

from doe.studies.monte_carlo.specification import Fitted, Study, Truth, load_study
from doe.studies.monte_carlo.study import StudyResult, dft_postures, pooled_rows, run_study

__all__ = ["Fitted", "Study", "StudyResult", "Truth", "dft_postures", "load_study", "pooled_rows", "run_study"]
