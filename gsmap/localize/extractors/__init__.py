"""Extractors of local features, one file each; the protocol is `gsmap.methods.extractor`."""
