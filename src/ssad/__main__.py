"""`python -m ssad` is `ssad`."""

from ssad.cli import main

main()
