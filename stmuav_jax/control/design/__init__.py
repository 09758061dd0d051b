"""Design of controllers: margins of the inputs, gains by gradients, gains over a posture."""
