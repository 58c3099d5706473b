"""The checker of annotations that tests/conftest.py installs: an int passes for a float, as type checkers have it."""

from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
