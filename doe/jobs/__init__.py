"""Running many tasks: workers, isolated processes, and tables of finished rows."""
