"""`python -m excite`."""

from .cli import main

main()
