"""`python -m services.cli` is the `intrasplat` command."""

from services.cli import main

main()
