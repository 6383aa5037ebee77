"""Authentication: API keys with roles, single-use tickets, and OpenID Connect."""
