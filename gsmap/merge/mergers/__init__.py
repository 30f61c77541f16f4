"""One file per way of merging; the contract is `gsmap.methods.merger.Merger`."""
