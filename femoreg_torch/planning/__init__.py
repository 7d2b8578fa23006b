"""Planning of a femoroplasty: a finite-element model of the femur, cement that strengthens it, and a path to inject it.

Research software, no medical device. Loads are those of a model; nobody has compared them with tests of bones.
"""
