"""State estimation: sigma-point Kalman filters, smoother, consistency, the report's quadrotor."""
