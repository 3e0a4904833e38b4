"""A calibration used on other measurements: validated, its base refitted, or taken as the prior."""

from identification.validate.validation import (
    DRAWN,
    HARDLY,
    Figures,
    Validation,
    drawing_in_words,
    drawing_residuals,
    is_better,
    validate,
    validation_sections,
    validation_verdict,
)

__all__ = [
    "DRAWN",
    "HARDLY",
    "Figures",
    "Validation",
    "drawing_in_words",
    "drawing_residuals",
    "is_better",
    "validate",
    "validation_sections",
    "validation_verdict",
]
