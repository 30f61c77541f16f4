"""Proposers: methods that find poses of a pair without an initial pose; the contract is `gsmap.methods.proposer`."""
