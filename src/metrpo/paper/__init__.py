"""The comparisons of the paper: which runs, which axes, and what they show."""
