//! Held keys and a dragging pointer, which move the camera. WASD and QE move, dragging turns, the wheel changes the distance or
//! the speed.

use crate::camera::ViewCamera;
use glam::Vec3;
use std::collections::BTreeSet;
use winit::event::{ElementState, KeyEvent, MouseButton, MouseScrollDelta, WindowEvent};
use winit::keyboard::{KeyCode, PhysicalKey};

/// Wheel pixels of a touchpad that count as a notch.
const PIXELS_PER_NOTCH: f32 = 40.0;

/// A key that went down.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pressed {
    /// Which.
    pub code: KeyCode,
    /// It has been down for a while, and the desktop says it again.
    pub is_repeat: bool,
}

/// What is held.
#[derive(Clone, Debug, Default)]
pub struct Controls {
    held: BTreeSet<KeyCode>,
    is_dragging: bool,
    pointer: [f32; 2],
}

impl Controls {
    /// Takes in a key; `Some` where it went down.
    pub fn key(&mut self, event: &KeyEvent) -> Option<Pressed> {
        let PhysicalKey::Code(code) = event.physical_key else { return None };
        self.take_key(code, event.state, event.repeat)
    }

    fn take_key(&mut self, code: KeyCode, state: ElementState, is_repeat: bool) -> Option<Pressed> {
        if state == ElementState::Released {
            self.held.remove(&code);
            return None;
        }
        self.held.insert(code);
        Some(Pressed { code, is_repeat })
    }

    /// Takes in what the pointer does, and turns `camera` by it.
    pub fn pointer(&mut self, event: &WindowEvent, camera: &mut ViewCamera) {
        match event {
            WindowEvent::CursorMoved { position, .. } => {
                let at = [position.x as f32, position.y as f32];
                if self.is_dragging {
                    camera.drag([at[0] - self.pointer[0], at[1] - self.pointer[1]]);
                }
                self.pointer = at;
            }
            WindowEvent::MouseInput { state, button: MouseButton::Left, .. } => {
                self.is_dragging = *state == ElementState::Pressed;
            }
            WindowEvent::MouseWheel { delta, .. } => camera.wheel(match delta {
                MouseScrollDelta::LineDelta(_, lines) => *lines,
                MouseScrollDelta::PixelDelta(pixels) => pixels.y as f32 / PIXELS_PER_NOTCH,
            }),
            _ => {}
        }
    }

    /// The window is not in front any more: what was held is let go unseen.
    pub fn let_go(&mut self) {
        self.held.clear();
        self.is_dragging = false;
    }

    /// Where the held keys walk, each axis -1 to 1: to the right, up, ahead.
    pub fn axes(&self) -> Vec3 {
        let is_held = |key| f32::from(u8::from(self.held.contains(&key)));
        let axis = |more, less| is_held(more) - is_held(less);
        Vec3::new(
            axis(KeyCode::KeyD, KeyCode::KeyA),
            axis(KeyCode::KeyE, KeyCode::KeyQ),
            axis(KeyCode::KeyW, KeyCode::KeyS),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ElementState::{Pressed as Down, Released as Up};

    #[test]
    fn keys_walk_while_they_are_held_and_the_window_is_in_front() {
        let mut controls = Controls::default();
        let press = controls.take_key(KeyCode::KeyW, Down, false);
        assert_eq!(press, Some(Pressed { code: KeyCode::KeyW, is_repeat: false }));
        controls.take_key(KeyCode::KeyA, Down, false);
        assert_eq!(controls.axes(), Vec3::new(-1.0, 0.0, 1.0));
        controls.take_key(KeyCode::KeyD, Down, false);
        assert_eq!(controls.axes(), Vec3::Z, "left and right together stand still");
        assert_eq!(controls.take_key(KeyCode::KeyW, Up, false), None);
        assert_eq!(controls.axes(), Vec3::ZERO);
        controls.take_key(KeyCode::KeyE, Down, false);
        controls.let_go();
        assert_eq!(controls.axes(), Vec3::ZERO);
    }
}
