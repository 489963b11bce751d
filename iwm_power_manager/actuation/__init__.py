"""What a command may do to the car; shared by the solver and the control law."""
