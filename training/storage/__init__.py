"""Files and processes: locks, tables, worker pools."""
