"""The Sphero BOLT: its protocol and driver, light to crossings, the on-board estimator, its virtual twin."""
