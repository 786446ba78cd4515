"""What a study's table of evaluations says: scores, statistics, figures, tables."""
