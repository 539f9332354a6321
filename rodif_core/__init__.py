"""Mathematics and simulation of RoDiF Studio: no HTTP, no SQL, no queue, no viewer."""
