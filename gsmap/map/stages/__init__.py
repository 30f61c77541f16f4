"""One file a stage: load from the store, call the pure stage, save what it returns under what made it."""
