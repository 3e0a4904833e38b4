"""File formats: arm, measurements, targets; read with error messages that say where, written whole or not at all."""
