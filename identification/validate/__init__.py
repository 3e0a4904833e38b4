"""A calibration used on other measurements: validated, its base refitted, or taken as the prior."""

from identification.validate.validation import Figures, Validation, drawing_residuals, validate

__all__ = ["Figures", "Validation", "drawing_residuals", "validate"]
