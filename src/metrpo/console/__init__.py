"""What a person sees in a terminal while runs go on, and how they stop them."""
