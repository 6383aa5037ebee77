"""How the service's processes meet: the runtime folder, and what goes over its sockets."""
