//! `XR_EXT_debug_utils`: messengers receive every refused call and the application's own messages, with its object names and
//! session labels.

use std::collections::HashMap;
use std::ffi::{CStr, CString, c_char, c_void};

use openxr_sys as xr;
use xr::Handle as _;

use crate::fault::{CallResult, Fault};
use crate::ffi::{self, entry};
use crate::runtime;

/// A callback of the application's.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Messenger {
    handle: u64,
    severities: xr::DebugUtilsMessageSeverityFlagsEXT,
    types: xr::DebugUtilsMessageTypeFlagsEXT,
    callback: xr::pfn::DebugUtilsMessengerCallbackEXT,
    user_data: *mut c_void,
}

// SAFETY: the user data is only handed back to the callback, which the specification lets any thread call.
unsafe impl Send for Messenger {}

impl Messenger {
    fn call(
        &self,
        severity: xr::DebugUtilsMessageSeverityFlagsEXT,
        types: xr::DebugUtilsMessageTypeFlagsEXT,
        data: &xr::DebugUtilsMessengerCallbackDataEXT,
    ) {
        if self.severities.intersects(severity) && self.types.intersects(types) {
            // SAFETY: the application's callback, with valid data; the runtime's lock is not held.
            unsafe { (self.callback)(severity, types, data, self.user_data) };
        }
    }
}

/// Names of objects, by kind and handle.
#[derive(Clone, Debug, Default)]
pub(crate) struct ObjectNames(HashMap<(i32, u64), CString>);

impl ObjectNames {
    fn set(&mut self, object: &xr::DebugUtilsObjectNameInfoEXT, name: CString) {
        let key = (object.object_type.into_raw(), object.object_handle);
        if name.is_empty() {
            self.0.remove(&key);
        } else {
            self.0.insert(key, name);
        }
    }

    fn of(&self, object: &xr::DebugUtilsObjectNameInfoEXT) -> *const c_char {
        let name = self.0.get(&(object.object_type.into_raw(), object.object_handle));
        name.map_or(object.object_name, |name| name.as_ptr())
    }
}

/// What a session says that it does: regions within each other, and a label that stands until the next.
#[derive(Clone, Debug, Default)]
pub(crate) struct Labels {
    regions: Vec<CString>,
    inserted: Option<CString>,
}

impl Labels {
    fn begin(&mut self, region: CString) {
        self.inserted = None;
        self.regions.push(region);
    }

    fn end(&mut self) {
        self.inserted = None;
        self.regions.pop();
    }

    fn insert(&mut self, label: CString) {
        self.inserted = Some(label);
    }

    fn newest_first(&self) -> Vec<xr::DebugUtilsLabelEXT> {
        let label = |name: &CString| xr::DebugUtilsLabelEXT {
            ty: xr::DebugUtilsLabelEXT::TYPE,
            next: std::ptr::null(),
            label_name: name.as_ptr(),
        };
        self.inserted.iter().chain(self.regions.iter().rev()).map(label).collect()
    }
}

/// A name that the application hands over.
fn text(name: *const c_char, what: &str) -> CallResult<CString> {
    if name.is_null() {
        return Err(Fault::usage(format!("{what} is null")));
    }
    // SAFETY: not null, and by the specification a text that ends with 0.
    Ok(unsafe { CStr::from_ptr(name) }.to_owned())
}

/// Tells messengers that a call was refused. The runtime's lock must not be held.
pub(crate) fn deliver(messengers: Vec<Messenger>, labels: &Labels, function: &str, message: &str) {
    let [Ok(function), Ok(message)] = [function, message].map(CString::new) else { return };
    let mut labels = labels.newest_first();
    let data = xr::DebugUtilsMessengerCallbackDataEXT {
        ty: xr::DebugUtilsMessengerCallbackDataEXT::TYPE,
        next: std::ptr::null(),
        message_id: c"shadecast-mock-runtime".as_ptr(),
        function_name: function.as_ptr(),
        message: message.as_ptr(),
        object_count: 0,
        objects: std::ptr::null_mut(),
        session_label_count: labels.len() as u32,
        session_labels: labels.as_mut_ptr(),
    };
    for messenger in messengers {
        let severity = xr::DebugUtilsMessageSeverityFlagsEXT::ERROR;
        messenger.call(severity, xr::DebugUtilsMessageTypeFlagsEXT::VALIDATION, &data);
    }
}

entry! {
    create_messenger: CreateDebugUtilsMessengerEXT = "xrCreateDebugUtilsMessengerEXT"(
        instance: value xr::Instance,
        create_info: input xr::DebugUtilsMessengerCreateInfoEXT,
        messenger: slot xr::DebugUtilsMessengerEXT,
    ) {
        let mut runtime = runtime::lock();
        let handle = runtime.new_handle();
        let core = runtime.core(instance)?;
        let callback = create_info.user_callback.ok_or_else(|| Fault::usage("userCallback is null"))?;
        if create_info.message_severities.is_empty() || create_info.message_types.is_empty() {
            return Err(Fault::usage("messageSeverities or messageTypes is empty"));
        }
        core.messengers.push(Messenger {
            handle,
            severities: create_info.message_severities,
            types: create_info.message_types,
            callback,
            user_data: create_info.user_data,
        });
        *messenger = xr::DebugUtilsMessengerEXT::from_raw(handle);
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    destroy_messenger: DestroyDebugUtilsMessengerEXT = "xrDestroyDebugUtilsMessengerEXT"(
        messenger: value xr::DebugUtilsMessengerEXT,
    ) {
        let mut runtime = runtime::lock();
        let instance = runtime.instance.as_mut().ok_or_else(|| Fault::handle("messenger"))?;
        let messengers = &mut instance.core.messengers;
        let index = messengers.iter().position(|known| known.handle == messenger.into_raw());
        messengers.swap_remove(index.ok_or_else(|| Fault::handle("messenger"))?);
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    submit_message: SubmitDebugUtilsMessageEXT = "xrSubmitDebugUtilsMessageEXT"(
        instance: value xr::Instance,
        severity: value xr::DebugUtilsMessageSeverityFlagsEXT,
        types: value xr::DebugUtilsMessageTypeFlagsEXT,
        callback_data: input xr::DebugUtilsMessengerCallbackDataEXT,
    ) {
        let (messengers, names, labels) = {
            let mut runtime = runtime::lock();
            let core = runtime.core(instance)?;
            let (messengers, names) = (core.messengers.clone(), core.object_names.clone());
            (messengers, names, runtime.labels())
        };
        // SAFETY: the objects are an array of the length that the application says.
        let objects = unsafe { ffi::array(callback_data.objects, callback_data.object_count, "objects") }?;
        let named = |object: &xr::DebugUtilsObjectNameInfoEXT| xr::DebugUtilsObjectNameInfoEXT {
            object_name: names.of(object),
            ..*object
        };
        let (mut objects, mut labels) = (objects.iter().map(named).collect::<Vec<_>>(), labels.newest_first());
        let data = xr::DebugUtilsMessengerCallbackDataEXT {
            objects: objects.as_mut_ptr(),
            session_label_count: labels.len() as u32,
            session_labels: labels.as_mut_ptr(),
            ..*callback_data
        };
        for messenger in messengers {
            messenger.call(severity, types, &data);
        }
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    set_object_name: SetDebugUtilsObjectNameEXT = "xrSetDebugUtilsObjectNameEXT"(
        instance: value xr::Instance,
        name_info: input xr::DebugUtilsObjectNameInfoEXT,
    ) {
        let mut runtime = runtime::lock();
        let core = runtime.core(instance)?;
        if name_info.object_handle == 0 {
            return Err(Fault::handle("object"));
        }
        let name = if name_info.object_name.is_null() { CString::default() } else { text(name_info.object_name, "objectName")? };
        core.object_names.set(name_info, name);
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    begin_label_region: SessionBeginDebugUtilsLabelRegionEXT = "xrSessionBeginDebugUtilsLabelRegionEXT"(
        session: value xr::Session,
        label_info: input xr::DebugUtilsLabelEXT,
    ) {
        runtime::lock().session(session)?.1.labels.begin(text(label_info.label_name, "labelName")?);
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    end_label_region: SessionEndDebugUtilsLabelRegionEXT = "xrSessionEndDebugUtilsLabelRegionEXT"(
        session: value xr::Session,
    ) {
        runtime::lock().session(session)?.1.labels.end();
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    insert_label: SessionInsertDebugUtilsLabelEXT = "xrSessionInsertDebugUtilsLabelEXT"(
        session: value xr::Session,
        label_info: input xr::DebugUtilsLabelEXT,
    ) {
        runtime::lock().session(session)?.1.labels.insert(text(label_info.label_name, "labelName")?);
        Ok(xr::Result::SUCCESS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(labels: &Labels) -> Vec<String> {
        // SAFETY: texts of labels that are alive.
        let name = |label: &xr::DebugUtilsLabelEXT| unsafe { CStr::from_ptr(label.label_name) };
        labels.newest_first().iter().map(|label| name(label).to_string_lossy().into_owned()).collect()
    }

    #[test]
    fn the_newest_label_is_first() {
        let mut labels = Labels::default();
        labels.begin(c"session".into());
        labels.insert(c"loading".into());
        labels.insert(c"loaded".into());
        assert_eq!(names(&labels), ["loaded", "session"]);
        labels.begin(c"frame".into());
        assert_eq!(names(&labels), ["frame", "session"]);
        labels.insert(c"drawing".into());
        assert_eq!(names(&labels), ["drawing", "frame", "session"]);
        labels.end();
        assert_eq!(names(&labels), ["session"]);
        labels.end();
        labels.end();
        assert!(names(&labels).is_empty());
    }

    #[test]
    fn an_object_has_the_name_that_it_was_given_last() {
        let object = |ty, object_handle| xr::DebugUtilsObjectNameInfoEXT {
            ty: xr::DebugUtilsObjectNameInfoEXT::TYPE,
            next: std::ptr::null(),
            object_type: ty,
            object_handle,
            object_name: std::ptr::null(),
        };
        let (space, session) = (object(xr::ObjectType::SPACE, 7), object(xr::ObjectType::SESSION, 7));
        let mut names = ObjectNames::default();
        names.set(&space, c"floor".into());
        names.set(&space, c"stage".into());
        // SAFETY: the name is alive.
        assert_eq!(unsafe { CStr::from_ptr(names.of(&space)) }, c"stage");
        assert!(names.of(&session).is_null(), "another kind of object");
        names.set(&space, CString::default());
        assert!(names.of(&space).is_null());
    }
}
