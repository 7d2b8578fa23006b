"""Learning to label bones in a CT: shapes of bones, random CTs around them, and the training of the network."""
