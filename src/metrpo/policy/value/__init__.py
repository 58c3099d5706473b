"""What values a state, so that advantages can be measured against it."""
