"""Part III of the report: the quadrotor's models, its eight cases, their assessment."""
