"""The simulated operating room.

`patient` makes patients, `physics` makes X-ray images of densities, `theatre` simulates a procedure on a patient,
`labelled` renders labelled views of patients, and `study` registers many procedures and tells the errors. Each floor
stands on those before it; `labelled` does not know `study`.
"""
