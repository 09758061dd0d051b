"""Solar tracker: geometry, kinematics, bodies, workspace, a day of pointing."""
