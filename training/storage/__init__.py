"""Files and processes: locks, jobs, worker pools."""
