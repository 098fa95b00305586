"""Mathematics, independent of the plant."""
