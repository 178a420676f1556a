"""``python -m toftools``."""

from toftools.cli import main

main()
