"""The comparisons of the paper, as data: which runs, which axes; and what runs and draws them."""
