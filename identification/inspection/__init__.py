"""What measurements are like before any fit: units, signs, frames, and other readings of the file."""
