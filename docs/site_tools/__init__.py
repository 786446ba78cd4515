"""What the documentation site is made with: generated pages, math, checks of links."""
