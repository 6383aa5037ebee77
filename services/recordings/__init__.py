"""Recordings that were uploaded: kept in a folder, checked in a process of their own, removed by age and size."""
