"""The fuzz: random files and command lines, and what is promised of every outcome."""
