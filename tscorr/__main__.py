"""`python -m tscorr` is the command `tscorr`."""

from tscorr.cli import main

main()
