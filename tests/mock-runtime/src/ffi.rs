//! The border to C: the conversion of raw pointers to references, and the macro that declares an entry point.
//!
//! All dereferencing of the application's pointers is here and in the few places that walk arrays. The proof is always the
//! same: OpenXR's valid usage makes the caller answer for pointers being null or valid for the call, aligned and, for outputs,
//! not aliased; null is refused here.

use std::ffi::{CStr, c_char, c_void};

use openxr_sys as xr;

use crate::fault::{CallResult, Fault};

/// An OpenXR structure that begins with its type and the next structure of its chain.
pub(crate) trait Structure {
    /// The type that it must carry.
    const TYPE: xr::StructureType;
    /// The type that it carries.
    fn structure_type(&self) -> xr::StructureType;
}

macro_rules! structures {
    ($($name:ident),* $(,)?) => {
        $(impl Structure for xr::$name {
            const TYPE: xr::StructureType = xr::$name::TYPE;
            fn structure_type(&self) -> xr::StructureType {
                self.ty
            }
        })*
    };
}

structures!(
    InstanceCreateInfo,
    InstanceProperties,
    SystemGetInfo,
    SystemProperties,
    SessionCreateInfo,
    SessionBeginInfo,
    GraphicsBindingVulkanKHR,
    GraphicsRequirementsVulkanKHR,
    VulkanInstanceCreateInfoKHR,
    VulkanDeviceCreateInfoKHR,
    VulkanGraphicsDeviceGetInfoKHR,
    ViewConfigurationProperties,
    ReferenceSpaceCreateInfo,
    ActionSpaceCreateInfo,
    SpaceLocation,
    SpaceVelocity,
    ViewLocateInfo,
    ViewState,
    View,
    ViewConfigurationView,
    FrameWaitInfo,
    FrameBeginInfo,
    FrameState,
    FrameEndInfo,
    CompositionLayerProjection,
    CompositionLayerProjectionView,
    CompositionLayerQuad,
    SwapchainCreateInfo,
    SwapchainImageAcquireInfo,
    SwapchainImageWaitInfo,
    SwapchainImageReleaseInfo,
    ActionSetCreateInfo,
    ActionCreateInfo,
    InteractionProfileSuggestedBinding,
    SessionActionSetsAttachInfo,
    InteractionProfileState,
    ActionsSyncInfo,
    BoundSourcesForActionEnumerateInfo,
    InputSourceLocalizedNameGetInfo,
    ActionStateGetInfo,
    ActionStateBoolean,
    ActionStateFloat,
    ActionStateVector2f,
    ActionStatePose,
    HapticActionInfo,
    DebugUtilsMessengerCreateInfoEXT,
    DebugUtilsMessengerCallbackDataEXT,
    DebugUtilsObjectNameInfoEXT,
    DebugUtilsLabelEXT,
    FoveationProfileCreateInfoFB,
    FoveationLevelProfileCreateInfoFB,
    SwapchainCreateInfoFoveationFB,
    SwapchainStateFoveationFB,
    SwapchainImageFoveationVulkanFB,
);

fn null(name: &str) -> Fault {
    Fault::usage(format!("{name} is null"))
}

fn checked<T: Structure>(found: xr::StructureType, name: &str) -> CallResult<()> {
    if found == T::TYPE {
        return Ok(());
    }
    let (found, needed) = (crate::names::structure(found), crate::names::structure(T::TYPE));
    Err(Fault::usage(format!("{name} has type {found}, it must have {needed}")))
}

/// A structure that the caller passes in.
///
/// # Safety
/// `pointer` is null, or valid for reads while `'a` lasts.
pub(crate) unsafe fn input<'a, T: Structure>(pointer: *const T, name: &str) -> CallResult<&'a T> {
    // SAFETY: by this function's own contract.
    let value = unsafe { pointer.as_ref() }.ok_or_else(|| null(name))?;
    checked::<T>(value.structure_type(), name)?;
    Ok(value)
}

/// A structure that the caller may pass in.
///
/// # Safety
/// As for [`input`].
pub(crate) unsafe fn optional<'a, T: Structure>(pointer: *const T, name: &str) -> CallResult<Option<&'a T>> {
    if pointer.is_null() {
        return Ok(None);
    }
    // SAFETY: by this function's own contract.
    unsafe { input(pointer, name) }.map(Some)
}

/// A structure that the caller wants filled in.
///
/// # Safety
/// `pointer` is null, or valid for reads and writes and not aliased while `'a` lasts.
pub(crate) unsafe fn output<'a, T: Structure>(pointer: *mut T, name: &str) -> CallResult<&'a mut T> {
    // SAFETY: by this function's own contract. The payload may be uninitialised, but it consists of integers and
    // floats, and is written before it is read.
    let value = unsafe { pointer.as_mut() }.ok_or_else(|| null(name))?;
    checked::<T>(value.structure_type(), name)?;
    Ok(value)
}

/// A plain value that the caller wants filled in: a handle, a count.
///
/// # Safety
/// As for [`output`].
pub(crate) unsafe fn slot<'a, T>(pointer: *mut T, name: &str) -> CallResult<&'a mut T> {
    // SAFETY: by this function's own contract.
    unsafe { pointer.as_mut() }.ok_or_else(|| null(name))
}

/// A zero-terminated text.
///
/// # Safety
/// `pointer` is null, or points to a zero-terminated string that lives while `'a` lasts.
pub(crate) unsafe fn text<'a>(pointer: *const c_char, name: &str) -> CallResult<&'a str> {
    if pointer.is_null() {
        return Err(null(name));
    }
    // SAFETY: not null, and zero-terminated by this function's own contract.
    let text = unsafe { CStr::from_ptr(pointer) };
    text.to_str().map_err(|_| Fault::usage(format!("{name} is not UTF-8")))
}

/// An array of the caller's.
///
/// # Safety
/// `pointer` is null, or valid for reads of `count` values while `'a` lasts.
pub(crate) unsafe fn array<'a, T>(pointer: *const T, count: u32, name: &str) -> CallResult<&'a [T]> {
    match (count, pointer.is_null()) {
        (0, _) => Ok(&[]),
        (_, true) => Err(null(name)),
        // SAFETY: not null, and valid for `count` values by this function's own contract.
        (_, false) => Ok(unsafe { std::slice::from_raw_parts(pointer, count as usize) }),
    }
}

/// The two-call idiom: tells how many items there are, and writes them where `capacity` is not 0.
/// `write` puts one item into one element and leaves the element's `type` and `next` alone.
///
/// # Safety
/// `count` is null or valid for a write; `buffer` is null or valid for reads and writes of `capacity` elements.
pub(crate) unsafe fn enumerate<T, I>(
    (capacity, count, buffer): (u32, *mut u32, *mut T),
    items: &[I],
    write: impl Fn(&mut T, &I),
) -> CallResult {
    // SAFETY: by this function's own contract.
    let count = unsafe { slot(count, "the count's address") }?;
    *count = items.len() as u32;
    if capacity == 0 {
        return Ok(xr::Result::SUCCESS);
    }
    if (capacity as usize) < items.len() {
        return Err(Fault::quiet(xr::Result::ERROR_SIZE_INSUFFICIENT));
    }
    if buffer.is_null() && !items.is_empty() {
        return Err(null("the array"));
    }
    for (index, item) in items.iter().enumerate() {
        // SAFETY: `index` is below `capacity`, for which `buffer` is valid by this function's own contract.
        write(unsafe { &mut *buffer.add(index) }, item);
    }
    Ok(xr::Result::SUCCESS)
}

/// The two-call idiom for structures, whose types the caller has set.
///
/// # Safety
/// As for [`enumerate`].
pub(crate) unsafe fn enumerate_structures<T: Structure, I>(
    (capacity, count, buffer): (u32, *mut u32, *mut T),
    name: &str,
    items: &[I],
    write: impl Fn(&mut T, &I),
) -> CallResult {
    if capacity as usize >= items.len() && !buffer.is_null() {
        for index in 0..items.len() {
            // SAFETY: `index` is below `capacity`, for which `buffer` is valid by this function's own contract.
            checked::<T>(unsafe { &*buffer.add(index) }.structure_type(), &format!("{name}[{index}]"))?;
        }
    }
    // SAFETY: by this function's own contract.
    unsafe { enumerate((capacity, count, buffer), items, write) }
}

/// The two-call idiom for a text, whose count includes the final zero.
///
/// # Safety
/// As for [`enumerate`].
pub(crate) unsafe fn enumerate_text(target: (u32, *mut u32, *mut c_char), text: &str) -> CallResult {
    let bytes: Vec<u8> = text.bytes().chain([0]).collect();
    // SAFETY: by this function's own contract.
    unsafe { enumerate(target, &bytes, |slot, byte| *slot = *byte as c_char) }
}

/// The structure of type `T` in a chain of outputs.
///
/// # Safety
/// `next` is null or begins a chain of valid OpenXR structures that the caller owns while `'a` lasts.
pub(crate) unsafe fn chained_output<'a, T: Structure>(next: *mut c_void) -> Option<&'a mut T> {
    let mut next = next.cast::<xr::BaseOutStructure>();
    // SAFETY: by this function's own contract each `next` is null or a valid structure.
    while let Some(base) = unsafe { next.as_ref() } {
        if base.ty == T::TYPE {
            // SAFETY: the structure says that it is a `T`, and nothing else refers to it during the call.
            return unsafe { next.cast::<T>().as_mut() };
        }
        next = base.next;
    }
    None
}

/// The structure of type `T` in a chain of inputs.
///
/// # Safety
/// `next` is null or begins a chain of valid OpenXR structures that live while `'a` lasts.
pub(crate) unsafe fn chained_input<'a, T: Structure>(next: *const c_void) -> Option<&'a T> {
    let mut next = next.cast::<xr::BaseInStructure>();
    // SAFETY: by this function's own contract each `next` is null or a valid structure.
    while let Some(base) = unsafe { next.as_ref() } {
        if base.ty == T::TYPE {
            // SAFETY: the structure says that it is a `T`.
            return unsafe { next.cast::<T>().as_ref() };
        }
        next = base.next;
    }
    None
}

/// Text of a fixed-size array of characters, up to its zero.
pub(crate) fn fixed_text(characters: &[c_char], name: &str) -> CallResult<String> {
    let bytes: Vec<u8> = characters.iter().take_while(|c| **c != 0).map(|c| *c as u8).collect();
    if bytes.len() == characters.len() {
        return Err(Fault::usage(format!("{name} has no final zero")));
    }
    String::from_utf8(bytes).map_err(|_| Fault::usage(format!("{name} is not UTF-8")))
}

/// Writes `text` into a fixed-size array of characters, cut to fit, with its final zero.
pub(crate) fn place_text(characters: &mut [c_char], text: &str) {
    let room = characters.len() - 1;
    let end = text.len().min(room);
    for (slot, byte) in characters.iter_mut().zip(text.as_bytes()[..end].iter().chain([&0])) {
        *slot = *byte as c_char;
    }
}

/// Declares an entry point: `entry! { wait_frame: WaitFrame = "xrWaitFrame"(session: value Session, ...) { body } }`.
///
/// The kinds of parameters: `value` is passed on; `input`, `optional`, `output`, `slot`, `text` go through the functions
/// above; `raw_in` and `raw_out` are pointers that the body hands to [`enumerate`] and the like. The body gives an
/// [`CallResult`]. The compiler checks the signature against the registry's.
macro_rules! entry {
    ($fn_name:ident: $pfn:ident = $name:literal ($($arg:ident: $kind:ident $ty:ty),* $(,)?) $body:block) => {
        pub(crate) unsafe extern "system" fn $fn_name($($arg: entry!(@type $kind $ty)),*) -> openxr_sys::Result {
            $crate::fault::guard($name, || {
                $(let $arg = entry!(@value $kind $arg);)*
                $body
            })
        }
        const _: openxr_sys::pfn::$pfn = $fn_name;
    };
    (@type value $ty:ty) => { $ty };
    (@type input $ty:ty) => { *const $ty };
    (@type optional $ty:ty) => { *const $ty };
    (@type raw_in $ty:ty) => { *const $ty };
    (@type text $ty:ty) => { *const $ty };
    (@type output $ty:ty) => { *mut $ty };
    (@type slot $ty:ty) => { *mut $ty };
    (@type raw_out $ty:ty) => { *mut $ty };
    (@value value $arg:ident) => { $arg };
    (@value raw_in $arg:ident) => { $arg };
    (@value raw_out $arg:ident) => { $arg };
    (@value $kind:ident $arg:ident) => {
        // SAFETY: a parameter of an OpenXR function: null or valid during the call (OpenXR, valid usage).
        unsafe { $crate::ffi::$kind($arg, stringify!($arg)) }?
    };
}
pub(crate) use entry;
