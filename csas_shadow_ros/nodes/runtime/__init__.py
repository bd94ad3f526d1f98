"""What nodes are built of."""
