"""Design of controllers: margins of the inputs, gains and shapes of references by gradients, schedules."""
