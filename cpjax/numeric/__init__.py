"""Mathematics that knows no cart-pole."""
