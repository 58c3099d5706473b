"""The policy, its improvement and the decision when to stop. Pure and jitted; knows neither environment nor disk."""
