"""The learned side: the ensemble of dynamics models, its fitting, and rollouts imagined through it. Pure and jitted."""
