"""A fast surrogate for the skin's finite elements: Coulomb friction is solved at the contact points, a small network gives the rest."""
