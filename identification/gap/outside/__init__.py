"""Outside the library: shapes without a name, waves of other orders, and which are excluded."""
