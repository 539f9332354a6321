"""REST endpoints, one router a noun. They translate; the use cases next door decide."""
