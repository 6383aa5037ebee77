"""Methods that do not beat their trivial baseline on all real recordings. Only registries name them; no default uses them."""
