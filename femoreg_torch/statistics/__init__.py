"""What a study says: tables, figures and a report of its runs, beside the paper's values."""
