//! `XR_EXT_debug_utils`: messengers hear of every refused call, and of what the application submits itself. Object
//! names and labels are accepted and not kept, since no message refers to them.

use std::ffi::{CString, c_void};

use openxr_sys as xr;
use xr::Handle as _;

use crate::fault::Fault;
use crate::ffi::entry;
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

/// Tells messengers that a call was refused. The runtime's lock must not be held.
pub(crate) fn deliver(messengers: Vec<Messenger>, function: &str, message: &str) {
    let [Ok(function), Ok(message)] = [function, message].map(CString::new) else { return };
    let data = xr::DebugUtilsMessengerCallbackDataEXT {
        ty: xr::DebugUtilsMessengerCallbackDataEXT::TYPE,
        next: std::ptr::null(),
        message_id: c"shadecast-mock-runtime".as_ptr(),
        function_name: function.as_ptr(),
        message: message.as_ptr(),
        object_count: 0,
        objects: std::ptr::null_mut(),
        session_label_count: 0,
        session_labels: std::ptr::null_mut(),
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
        let messengers = runtime::lock().core(instance)?.messengers.clone();
        for messenger in messengers {
            messenger.call(severity, types, callback_data);
        }
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    set_object_name: SetDebugUtilsObjectNameEXT = "xrSetDebugUtilsObjectNameEXT"(
        instance: value xr::Instance,
        name_info: input xr::DebugUtilsObjectNameInfoEXT,
    ) {
        runtime::lock().core(instance)?;
        match name_info.object_handle {
            0 => Err(Fault::handle("object")),
            _ => Ok(xr::Result::SUCCESS),
        }
    }
}

entry! {
    begin_label_region: SessionBeginDebugUtilsLabelRegionEXT = "xrSessionBeginDebugUtilsLabelRegionEXT"(
        session: value xr::Session,
        label_info: input xr::DebugUtilsLabelEXT,
    ) {
        let _ = label_info;
        runtime::lock().session(session)?;
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    end_label_region: SessionEndDebugUtilsLabelRegionEXT = "xrSessionEndDebugUtilsLabelRegionEXT"(
        session: value xr::Session,
    ) {
        runtime::lock().session(session)?;
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    insert_label: SessionInsertDebugUtilsLabelEXT = "xrSessionInsertDebugUtilsLabelEXT"(
        session: value xr::Session,
        label_info: input xr::DebugUtilsLabelEXT,
    ) {
        let _ = label_info;
        runtime::lock().session(session)?;
        Ok(xr::Result::SUCCESS)
    }
}
