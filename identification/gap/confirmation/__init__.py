"""Whether other rows confirm what was found."""
