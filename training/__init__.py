"""Learning from recordings and simulated data: data sets with labels, models, evaluation, studies."""
