"""What runs say, for people: health in plain words, a page, curves, a live table. It only reads runs."""
