"""Ways to sharpen a pose once it is nearly right; the contract is `gsmap.methods.refiner`."""
