"""One file for each change of the schema, the oldest number first."""
