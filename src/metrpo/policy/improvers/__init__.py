"""The ways to improve a policy in the ensemble."""
