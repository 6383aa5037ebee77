"""Who may do what: API keys with roles, tickets for one use, and the guard that stands before every route."""
