"""What travels on the wire, one module a noun: XxxCreate in, XxxOut out."""
