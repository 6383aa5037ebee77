"""Entry point of `python -m services.cli`, the `intrasplat` command."""

from services.cli import main

main()
