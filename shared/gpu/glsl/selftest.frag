#version 460
#extension GL_EXT_multiview : require
// Each view gets its own number, so that a driver that draws one view only is found out.
layout(push_constant) uniform SelftestPush { uint first_number; };
layout(location = 0) out uint number;
void main() { number = first_number + gl_ViewIndex; }
