"""Built-in executors, one per file; `gsmap.methods.executor` has their contract."""
