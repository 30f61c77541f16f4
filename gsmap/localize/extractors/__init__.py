"""Extractors, one file each: from pictures to local features. The contract is in `gsmap.methods.extractor`."""
