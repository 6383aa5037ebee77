"""What `intrasplat serve` puts together: the control plane's protocols, met by the supervisor, the display, the registry and the console."""
