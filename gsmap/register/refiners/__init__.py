"""Ways to sharpen a pose once it is nearly right."""
