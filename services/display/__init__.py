"""Pictures for people: encoded once, handed to any number of viewers."""
