"""Built-in merging methods, one file each; the contract is `gsmap.methods.merger.Merger`."""
