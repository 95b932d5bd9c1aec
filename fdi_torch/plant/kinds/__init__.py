"""The kinds of flow component, one file each; `PlantDescription` has one field for each kind."""
