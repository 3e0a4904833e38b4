"""Pictures and pages. Everything here reads results; nothing solves."""
