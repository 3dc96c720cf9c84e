"""Entry point of `python -m ssad`."""

from ssad.cli import main

main()
