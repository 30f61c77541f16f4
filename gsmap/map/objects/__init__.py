"""Associate segments over captures as objects, and report them."""
