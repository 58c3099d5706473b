"""Tasks whose reward and termination are known formulas."""
