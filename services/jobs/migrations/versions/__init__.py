"""Migrations, one file per schema change, in ascending order."""
