"""Ways to find poses of a pair of scenes without knowing any; the contract is `gsmap.methods.proposer`."""
