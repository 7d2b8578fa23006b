"""What the images say of a result, in numbers: how sure poses are, and what moved, is bent, or is another thing."""
