"""The page's controls, a panel each."""
