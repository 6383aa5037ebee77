"""Authentication and authorisation: API keys with roles, single-use tickets, and the guard of every
route."""
