"""Force elements: applied to bodies, and along the coordinates of joints. Floor 3."""
