"""Proposers: methods that find poses of a pair without a start; the contract is `gsmap.methods.proposer`."""
