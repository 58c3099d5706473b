"""Learning curves as pictures, in one style."""
