"""Refiners: methods that refine an approximate pose; the contract is `gsmap.methods.refiner`."""
