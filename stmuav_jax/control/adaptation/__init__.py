"""Online estimation of a payload, and controllers that are told of it. Floor of control."""
