"""What ME-TRPO is compared with: learning in the real environment, with the same metrics and run directories."""
