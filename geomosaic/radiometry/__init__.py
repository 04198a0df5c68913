"""From recorded values to reflectance: sensor models, the sun, sun sensors and reflectance panels."""
