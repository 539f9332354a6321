"""SQL tables, one module a noun, and the artifact store. Nothing here commits."""
