"""File formats: arm, measurements, targets; read with complaints that say where, written whole or not at all."""
